"""Watch a training in TensorBoard: what it imagines beside what happens, and how its risks are spread."""

from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_esad.common.checks import require
from sb3_esad.common.cost_limited_algorithm import CostLimitedAlgorithm
from sb3_esad.common.latent_algorithm import LatentAlgorithm
from sb3_esad.common.noise import fixed_seed
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.common.type_aliases import LatentState
from sb3_esad.film import side_by_side, write_film


class WatchCallback(BaseCallback):
    """
    Shows a histogram of the risk and a training episode beside what was imagined from its first steps.

    The histogram holds Gamma of the actions that the policy has taken since the last one. There is a film where the algorithm
    has a world model and the observations have an image; its episode comes from the replay buffer, so no step is made for it.

    :param every: environment steps between two looks
    :param length: steps of a film at most
    :param looks: observations that the model is shown before it goes on alone, given the actions really taken
    :raises ValueError: if an argument is out of its range, the model has no risk, or there is no TensorBoard to write to
    """

    model: Any

    def __init__(self, every: int = 5000, length: int = 50, looks: int = 5) -> None:
        super().__init__()
        require(every >= 1, "every", every, "a number of steps >= 1")
        require(length >= 1, "length", length, "a number of steps >= 1")
        require(looks >= 1, "looks", looks, "a number of observations >= 1")
        self.every = every
        self.length = length
        self.looks = looks

    def _on_training_start(self) -> None:
        name = type(self.model).__name__
        if not isinstance(self.model, CostLimitedAlgorithm):
            raise ValueError(f"{name} expects no risk to show; give WatchCallback to ESADLEND, WCSAC or their kin.")
        self._outputs = [each for each in self.logger.output_formats if isinstance(each, TensorBoardOutputFormat)]
        if not self._outputs:
            raise ValueError(f"{name} has tensorboard_log=None, but WatchCallback writes there; choose a folder for it.")
        self._risks: list[th.Tensor] = []
        self._last = self.num_timesteps

    def _on_step(self) -> bool:
        if self.model.last_risk is not None:
            self._risks.append(self.model.last_risk)
        if self.num_timesteps - self._last >= self.every:
            self._last = self.num_timesteps
            self._show_risks()
            if isinstance(self.model, LatentAlgorithm):
                self._show_films(self.model)
        return True

    def _show_risks(self) -> None:
        if self._risks:
            risks, self._risks = th.cat(self._risks).cpu(), []
            for output in self._outputs:  # what is recorded before the logger's next dump would replace it there
                output.write({"safety/risk": risks}, {"safety/risk": ()}, self.num_timesteps)

    def _show_films(self, model: LatentAlgorithm) -> None:
        world_model = model.policy.average.world_model
        if not world_model.preprocessing.image_keys:
            return
        episode = model.replay_buffer.latest_episode(self.length, env=model._vec_normalize_env)
        if episode is None:
            return
        before, after, actions = episode
        seen = preprocess_obs(_append(before, after), model.observation_space, model.policy.normalize_images)
        imagined = imagine_episode(model.policy, before, after, actions, self.looks)
        for key, real in world_model.preprocessing.images(seen).items():
            film = side_by_side(real, imagined[key], self.looks)
            for output in self._outputs:
                write_film(output, f"imagination/film_{key}", film, self.num_timesteps)


@th.no_grad()
def imagine_episode(
    policy: LatentPolicy, before: PyTorchObs, after: PyTorchObs, actions: th.Tensor, looks: int
) -> dict[str, th.Tensor]:
    """
    Look at the first observations of an episode and imagine how it goes on, by the running averages that drive.

    :param policy: whose world model imagines; random numbers outside stay as they were
    :param before: observations before each of L actions, of shape (L, ...)
    :param after: observations after them
    :param actions: scaled to [-1, 1], of shape (L, A)
    :param looks: observations that it is shown, at least one
    :return: preprocessed observations by key, of shape (L + 1, ...)
    """
    agent, start = policy.average, th.ones(1, dtype=th.bool, device=policy.device)
    with fixed_seed(policy.device):
        states = [agent.observe(_at(before, 0), policy.initial_state(1), start, deterministic=True).state]
        for step, action in enumerate(actions):
            state = states[-1]._replace(action=action[None])
            if step + 1 < looks:
                states.append(agent.observe(_at(after, step), state, ~start, deterministic=True).state)
            else:
                states.append(agent.world_model.rssm.imagine(state))
        return agent.world_model.reconstruct(LatentState(*map(th.cat, zip(*states, strict=True))))


def _at(observations: PyTorchObs, step: int) -> PyTorchObs:
    if isinstance(observations, dict):
        return {key: each[step : step + 1] for key, each in observations.items()}
    return observations[step : step + 1]


def _append(before: PyTorchObs, after: PyTorchObs) -> PyTorchObs:
    """The first observation and all that followed, of shape (L + 1, ...)."""
    if isinstance(before, dict):
        assert isinstance(after, dict)
        return {key: th.cat([before[key][:1], after[key]]) for key in before}
    assert isinstance(after, th.Tensor)
    return th.cat([before[:1], after])
