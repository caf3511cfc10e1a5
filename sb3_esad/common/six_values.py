"""Environments that return their cost as a value of its own."""

from typing import Any, SupportsFloat

import gymnasium

from sb3_esad.common.checks import require


class CostFromSixValues(gymnasium.Wrapper[Any, Any, Any, Any]):
    """
    Lets an environment whose step returns six values be used: its cost goes into ``info["cost"]``.

    Six values are Safety-Gymnasium's convention: observation, reward, cost, terminated, truncated, info.

    :param env: such an environment
    :param max_cost: the largest cost of a step, which becomes 1; divide ``cost_limit`` by it, too
    :raises ValueError: if ``max_cost`` is not above 0
    """

    def __init__(self, env: gymnasium.Env[Any, Any], max_cost: float = 1.0) -> None:
        super().__init__(env)
        require(max_cost > 0, "max_cost", max_cost, "a number above 0")
        self.max_cost = max_cost

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        Step the environment.

        :param action: passed on
        :return: observation, reward, terminated, truncated, info with the cost
        :raises ValueError: if the environment does not return six values
        """
        values: tuple[Any, ...] = self.env.step(action)
        if len(values) != 6:
            raise ValueError(f"{self.env} returned {len(values)} values instead of six; use it without this wrapper.")
        observation, reward, cost, terminated, truncated, info = values
        return observation, reward, terminated, truncated, {**info, "cost": float(cost) / self.max_cost}
