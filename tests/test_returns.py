"""Returns along trajectories against closed forms and brute force."""

import pytest
import torch as th

from sb3_esad.common.functional import cost_variance_target, expected_squared_error, indicator_joint
from sb3_esad.common.returns import corrected_return, lambda_return


def t(*values: float) -> th.Tensor:
    return th.tensor(values, dtype=th.float64).squeeze()


@pytest.mark.parametrize(
    ("lambda_", "expected"), [(1.0, [2.75, 3.5, 5.0]), (0.0, [5.0, 5.0, 5.0]), (0.5, [4.0625, 4.25, 5.0])]
)
def test_lambda_return_known_values(lambda_: float, expected: list[float]) -> None:
    ones, values = th.ones(3), th.full((3,), 8.0)
    assert lambda_return(ones, ones, values, 0.5, lambda_).tolist() == pytest.approx(expected)


def test_lambda_return_stops_at_the_end_of_an_episode() -> None:
    returns = lambda_return(th.ones(3), t(1.0, 0.0, 1.0).float(), th.full((3,), 8.0), 0.5, 1.0)
    assert returns.tolist() == pytest.approx([1.5, 1.0, 5.0])


@pytest.mark.parametrize("lambda_", [0.0, 0.3, 0.95, 1.0])
def test_lambda_return_is_the_mixture_of_n_step_returns(lambda_: float) -> None:
    gamma, length = 0.9, 5
    rewards, continues, values = th.rand(3, 4, length), th.rand(4, length).expand(3, 4, length), th.rand(3, 4, length)

    def n_step(t: int, n: int) -> th.Tensor:
        total, weight = th.zeros(3, 4), th.ones(3, 4)
        for i in range(t, t + n):
            total = total + weight * rewards[..., i]
            weight = weight * gamma * continues[..., i]
        return total + weight * values[..., t + n - 1]

    returns = lambda_return(rewards, continues, values, gamma, lambda_)
    for start in range(length):
        longest = length - start
        mixture = sum((1 - lambda_) * lambda_ ** (n - 1) * n_step(start, n) for n in range(1, longest))
        mixture = mixture + lambda_ ** (longest - 1) * n_step(start, longest)
        th.testing.assert_close(returns[..., start], mixture)


def test_variance_of_several_steps_is_a_lambda_return() -> None:
    cost, continues, q, q_next, v_next = th.rand(5, 3, 4, dtype=th.float64)
    joint = indicator_joint(cost, continues, 0.0)
    error = expected_squared_error(cost, cost, joint, continues, q, q_next, 0.9)
    one_step = lambda_return(error, continues, v_next, 0.9**2, 0.0)
    th.testing.assert_close(one_step, cost_variance_target(cost, continues, q, q_next, v_next, 0.9))


def test_corrected_return_of_the_policy_itself_is_a_lambda_return() -> None:
    rewards, continues, values = th.rand(3, 4, 6, dtype=th.float64)
    last = th.rand(4, 1, dtype=th.float64)
    next_values = th.cat([values[:, 1:], last], dim=1)  # what is done next is what the policy would do
    returns = corrected_return(rewards, continues, values, next_values, th.full_like(rewards, 0.8), 0.9)
    th.testing.assert_close(returns, lambda_return(rewards, continues, next_values, 0.9, 0.8))


def test_corrected_return_sums_up_surprises() -> None:
    rewards, continues, values, next_values, traces = th.rand(5, 4, 6, dtype=th.float64)
    surprises = rewards + 0.9 * continues * next_values - values
    expected = values.clone()
    for t in range(6):
        for k in range(t, 6):
            expected[:, t] += (0.9 * continues[:, t:k] * traces[:, t:k]).prod(dim=1) * surprises[:, k]
    returns = corrected_return(rewards, continues, values, next_values, traces, 0.9)
    th.testing.assert_close(returns, expected)


def test_corrected_return_is_not_frightened_by_what_the_policy_would_not_do() -> None:
    """A safe step, then a crash by an action whose cost is known; the policy would have taken a safe one."""
    returns = corrected_return(t([0.0, 1.0]), t([1.0, 0.0]), t([0.3, 1.0]), t([0.0, 0.0]), t([1.0, 0.0]), 0.9)
    assert returns.tolist() == [0.0, 1.0]
