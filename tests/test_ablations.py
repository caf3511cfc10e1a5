"""The ablations are objects in place of others, and nothing else."""

import pytest
import torch as th

from sb3_esad import ADEND, ESADLEND, SADLEN
from sb3_esad.common.latents import GaussianHead
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.penalties import NoPenalty
from tests.conftest import TINY, CountingEnv


@pytest.mark.parametrize("ablation", [SADLEN, ADEND])
def test_no_method_of_their_own(ablation: type[ESADLEND]) -> None:
    assert not [name for name, value in vars(ablation).items() if callable(value) and not isinstance(value, type)]


def test_sad_len_has_no_diffusion_model() -> None:
    model = SADLEN("MlpPolicy", CountingEnv(), **TINY)
    assert type(model.policy.world_model.rssm.head) is GaussianHead
    assert isinstance(model.penalty, AugmentedLagrangian)


def actor_weights(model_class: type[ESADLEND], monkeypatch: pytest.MonkeyPatch) -> th.Tensor:
    """Train with cost critics that say nonsense."""
    model = model_class("MlpPolicy", CountingEnv(), **TINY)
    with monkeypatch.context() as patch:
        patch.setattr(type(model.policy.cost_critic), "forward", lambda self, grid, action: nonsense(grid))
        model.learn(40)
    return th.nn.utils.parameters_to_vector(model.policy.actor.parameters())


def nonsense(grid: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    return th.full((2, len(grid)), th.nan), th.full((len(grid),), th.nan)


def test_no_cost_reaches_the_actor_of_ad_end(monkeypatch: pytest.MonkeyPatch) -> None:
    model = ADEND("MlpPolicy", CountingEnv(), **TINY)
    assert isinstance(model.penalty, NoPenalty)
    undisturbed = th.nn.utils.parameters_to_vector(model.learn(40).policy.actor.parameters())
    assert th.equal(actor_weights(ADEND, monkeypatch), undisturbed)
    with pytest.raises(ValueError, match=r"An action is nan after .* updates: learning has diverged"):
        actor_weights(ESADLEND, monkeypatch)
