"""Weight of the policy's entropy, learned or fixed."""

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import torch as th
from torch import nn

from sb3_esad.common.type_aliases import TensorLogs


class EntropyCoefficient(nn.Module, ABC):
    """The weight of the entropy in the actor's objective, called beta or temperature in the literature."""

    optimizer_names: ClassVar[tuple[str, ...]] = ()
    """Attributes that are optimisers, to be saved and scheduled with the others."""

    @abstractmethod
    def forward(self) -> th.Tensor:
        """
        Give the coefficient.

        :return: scalar, without gradient
        """

    @abstractmethod
    def update(self, log_prob: th.Tensor) -> TensorLogs:
        """
        Adapt to the entropy of the policy.

        :param log_prob: (...), log-probabilities of sampled actions; the entropy is minus their mean
        :return: values to log
        """


class FixedCoefficient(EntropyCoefficient):
    """
    A coefficient that stays as it is.

    :param value: the coefficient, >= 0
    """

    value: th.Tensor

    def __init__(self, value: float) -> None:
        super().__init__()
        if value < 0:
            raise ValueError(f'ent_coef is {value}; choose a number >= 0 or "auto" to learn it.')
        self.register_buffer("value", th.tensor(float(value)))

    def forward(self) -> th.Tensor:
        return self.value

    def update(self, log_prob: th.Tensor) -> TensorLogs:
        return {"ent_coef": self.value.detach()}


class LearnedCoefficient(EntropyCoefficient):
    """
    A coefficient that keeps the entropy at a target, J = E[log beta (H - H0)] (Haarnoja et al., SAC, 2018, Eq. 18).

    :param target_entropy: H0, in nats
    :param init: initial coefficient, > 0
    :param bounds: lowest and highest coefficient
    :param learning_rate: of the logarithm of the coefficient
    """

    optimizer_names: ClassVar[tuple[str, ...]] = ("optimizer",)

    def __init__(
        self,
        target_entropy: float,
        init: float = 1.0,
        bounds: tuple[float, float] = (1e-4, 1.0),
        learning_rate: float = 3e-4,
    ) -> None:
        super().__init__()
        if not 0 < bounds[0] <= init <= bounds[1]:
            raise ValueError(f"The initial ent_coef is {init}; choose it within its bounds {bounds[0]} and {bounds[1]}.")
        self.target_entropy = target_entropy
        self.log_bounds = math.log(bounds[0]), math.log(bounds[1])
        self.log_coefficient = nn.Parameter(th.tensor(math.log(init)))
        self.optimizer = th.optim.Adam([self.log_coefficient], lr=learning_rate)

    def forward(self) -> th.Tensor:
        return self.log_coefficient.detach().exp()

    def update(self, log_prob: th.Tensor) -> TensorLogs:
        excess = -log_prob.detach().mean() - self.target_entropy
        # The logarithm, as in SB3, not the coefficient itself: a small coefficient would hardly ever recover.
        loss = self.log_coefficient * excess
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        with th.no_grad():
            self.log_coefficient.clamp_(*self.log_bounds)
        return {"ent_coef": self(), "ent_coef_loss": loss.detach()}


def make_entropy_coefficient(ent_coef: str | float, target_entropy: float, learning_rate: float = 3e-4) -> EntropyCoefficient:
    """
    Build the coefficient from SB3's notation.

    :param ent_coef: a number to fix it, ``"auto"`` to learn it from 1, ``"auto_0.1"`` to learn it from 0.1
    :param target_entropy: H0 of a learned coefficient, in nats
    :param learning_rate: of a learned coefficient
    :return: the coefficient
    :raises ValueError: if ``ent_coef`` is neither
    """
    name, _, init = str(ent_coef).partition("_")
    learned = name == "auto"
    try:
        value = float(init or 1.0) if learned else float(ent_coef)
    except ValueError as error:
        raise ValueError(f'ent_coef is {ent_coef!r}; choose a number, "auto", or "auto_0.1" to start from 0.1.') from error
    return LearnedCoefficient(target_entropy, value, learning_rate=learning_rate) if learned else FixedCoefficient(value)
