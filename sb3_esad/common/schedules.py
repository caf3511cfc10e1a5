"""How a learning rate goes on."""

from sb3_esad.common.checks import require


class HoldThenFall:
    """
    Hold a value at first, then let it fall to zero in a straight line.

    :param start: value that is held
    :param hold: share of the training during which it is, in [0, 1)
    :raises ValueError: if ``hold`` is outside [0, 1)
    """

    def __init__(self, start: float, hold: float) -> None:
        require(0 <= hold < 1, "hold", hold, "a share of the training in [0, 1)")
        self.start = start
        self.hold = hold

    def __call__(self, progress_remaining: float) -> float:
        """
        Give the value.

        :param progress_remaining: share of the training that lies ahead, from 1 to 0 or, where the last rollout
            goes on beyond the end, below
        :return: the value at this moment
        """
        return self.start * min(1.0, max(progress_remaining, 0.0) / (1.0 - self.hold))

    def __repr__(self) -> str:
        return f"HoldThenFall(start={self.start}, hold={self.hold})"
