"""Muon for matrices and kernels, Adam for the rest."""

import io
import pickle
from copy import deepcopy

import pytest
import torch as th
from torch import nn

from sb3_esad.common.optimizers import MuonWithAdam


def backward(network: nn.Module, seed: int = 0) -> None:
    inputs = th.randn(8, 3, 8, 8, generator=th.Generator().manual_seed(seed))
    network.zero_grad()
    network(inputs).square().sum().backward()


def small_network(channels_last: bool = False) -> nn.Sequential:
    th.manual_seed(0)
    network = nn.Sequential(nn.Conv2d(3, 24, 4, stride=4), nn.SiLU(), nn.Conv2d(24, 20, 1), nn.Flatten(), nn.Linear(80, 1))
    return network.to(memory_format=th.channels_last) if channels_last else network  # type: ignore[call-overload]


@pytest.mark.parametrize("shape", [(32, 64), (64, 32), (24, 3, 4, 4)])
def test_a_step_is_orthogonal_and_as_large_as_adams(shape: tuple[int, ...]) -> None:
    """All singular values are near 0.2 lr sqrt(max(m, n)), so that the root mean square of the entries is 0.2 lr."""
    weight = nn.Parameter(th.zeros(shape))
    optimizer = MuonWithAdam([weight], lr=0.01)
    weight.grad = th.randn(shape, generator=th.Generator().manual_seed(1))
    optimizer.step()
    matrix = weight.detach().flatten(1)
    values = th.linalg.svdvals(matrix) / (0.2 * 0.01 * max(matrix.shape) ** 0.5)
    assert values.min() > 0.6 and values.max() < 1.3


def test_a_matrix_moves_as_by_muon_and_a_bias_as_by_adam() -> None:
    matrix, bias = nn.Parameter(th.randn(16, 20)), nn.Parameter(th.randn(16))
    twins = [nn.Parameter(p.detach().clone()) for p in (matrix, bias)]
    together = MuonWithAdam([matrix, bias], lr=0.01)
    muon = th.optim.Muon(twins[:1], lr=0.01, weight_decay=0.0, adjust_lr_fn="match_rms_adamw")
    adam = th.optim.Adam(twins[1:], lr=0.01, betas=(0.9, 0.99))
    for _ in range(3):
        for p, twin in zip((matrix, bias), twins, strict=True):
            p.grad = th.randn_like(p)
            twin.grad = p.grad.clone()
        for optimizer in (together, muon, adam):
            optimizer.step()
    th.testing.assert_close(matrix, twins[0])
    th.testing.assert_close(bias, twins[1])


def test_the_order_in_memory_does_not_matter() -> None:
    networks = [small_network(), small_network(channels_last=True)]
    for network in networks:
        optimizer = MuonWithAdam(network.parameters(), lr=0.01)
        for seed in range(3):
            backward(network, seed)
            optimizer.step()
    for one, other in zip(networks[0].parameters(), networks[1].parameters(), strict=True):
        th.testing.assert_close(one, other.contiguous(), rtol=1e-3, atol=1e-5)


def test_it_goes_on_from_a_saved_state_and_from_loaded_weights() -> None:
    network = small_network()
    optimizer = MuonWithAdam(network.parameters(), lr=0.01)
    backward(network)
    optimizer.step()
    other = small_network()
    successor = MuonWithAdam(other.parameters(), lr=0.5)
    other.load_state_dict(deepcopy(network.state_dict()))
    successor.load_state_dict(deepcopy(optimizer.state_dict()))
    for each, its_optimizer in ((network, optimizer), (other, successor)):
        backward(each, 1)
        its_optimizer.step()
    for one, another in zip(network.parameters(), other.parameters(), strict=True):
        assert th.equal(one, another)


def test_a_learning_rate_of_zero_moves_nothing() -> None:
    network = small_network()
    optimizer = MuonWithAdam(network.parameters(), lr=0.01)
    optimizer.param_groups[0]["lr"] = 0.0
    before = deepcopy(network.state_dict())
    backward(network)
    optimizer.step()
    assert all(th.equal(before[name], value) for name, value in network.state_dict().items())


def test_it_goes_on_where_the_network_was_moved_to_after_loading() -> None:
    """As with a model that is loaded to a GPU: the network moves first, then the optimiser's state is loaded."""
    network = small_network()
    optimizer = MuonWithAdam(network.parameters(), lr=0.01)
    backward(network)
    optimizer.step()
    moved = small_network()
    successor = MuonWithAdam(moved.parameters(), lr=0.01)
    moved.double()
    successor.load_state_dict(optimizer.state_dict())
    for parameter in moved.parameters():
        parameter.grad = th.randn_like(parameter)
    successor.step()
    assert all(parameter.dtype == th.float64 and parameter.isfinite().all() for parameter in moved.parameters())


def test_a_copy_of_a_network_has_an_optimiser_of_its_own() -> None:
    network = small_network()
    network.optimizer = MuonWithAdam(network.parameters(), lr=0.01)  # type: ignore[assignment]
    backward(network)
    network.optimizer.step()  # type: ignore[union-attr, operator]
    stored = io.BytesIO()
    pickle.dump(network, stored)
    before = deepcopy(network.state_dict())
    for copy in (deepcopy(network), pickle.loads(stored.getvalue())):
        backward(copy, 1)
        copy.optimizer.step()
        assert all(th.equal(before[name], value) for name, value in network.state_dict().items())
        assert not any(th.equal(before[name], value) for name, value in copy.state_dict().items())


def test_what_has_no_gradient_stays() -> None:
    matrix, bias = nn.Parameter(th.ones(16, 16)), nn.Parameter(th.ones(3))
    optimizer = MuonWithAdam([matrix, bias], lr=0.1)
    bias.grad = th.ones(3)
    optimizer.step()
    assert (matrix == 1).all() and (bias < 1).all()


@pytest.mark.parametrize(("shape", "muon"), [((15, 40), False), ((40, 15), False), ((16, 16), True), ((16,), False)])
def test_small_layers_are_left_to_adam(shape: tuple[int, ...], muon: bool) -> None:
    (part,) = MuonWithAdam([nn.Parameter(th.ones(shape))], lr=0.1).parts
    assert isinstance(part, th.optim.Muon if muon else th.optim.Adam)


def test_a_closure_computes_the_gradient() -> None:
    bias = nn.Parameter(th.ones(3))
    optimizer = MuonWithAdam([bias], lr=0.1)

    def closure() -> float:
        loss = bias.square().sum()
        loss.backward()
        return loss.item()

    assert optimizer.step(closure) == 3.0
    assert (bias < 1).all()


def test_other_groups_and_other_states_are_refused() -> None:
    optimizer = MuonWithAdam([nn.Parameter(th.ones(3))], lr=0.1)
    with pytest.raises(ValueError, match="one group of parameters"):
        optimizer.add_param_group({"params": [nn.Parameter(th.ones(3))]})
    adam = th.optim.Adam([nn.Parameter(th.ones(3))])
    with pytest.raises(ValueError, match="no state of MuonWithAdam: use the optimizer_class"):
        optimizer.load_state_dict(adam.state_dict())


@pytest.mark.parametrize(("part", "index", "name"), [(0, 0, "momentum_buffer"), (1, 0, "exp_avg"), (1, 99, "exp_avg")])
def test_averages_of_another_shape_are_refused(part: int, index: int, name: str) -> None:
    """Torch's fused kernel would write beyond their end; what is left is as good as new."""
    network = small_network()
    optimizer = MuonWithAdam(network.parameters(), lr=0.01)
    backward(network)
    optimizer.step()
    state = deepcopy(optimizer.state_dict())
    state["parts"][part]["state"].setdefault(index, {})[name] = th.zeros(1)
    with pytest.raises(ValueError, match=rf"The state '{name}' has the shape \(1,\): load one of the same networks"):
        optimizer.load_state_dict(state)
    optimizer.step()
    assert all(parameter.isfinite().all() for parameter in network.parameters())
