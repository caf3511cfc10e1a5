"""Sums over the latest steps only."""

import torch as th
from torch import nn


class RecentSums(nn.Module):
    """
    Sums of several quantities over about the latest ``steps`` steps, which are forgotten block by block.

    Not a moving average: its tail would remember for three times as long what an agent that has learned since then has done.

    :param names: of the quantities
    :param steps: length of the window, until another is set
    :param blocks: into how many parts it is cut; the window holds ``steps`` to within a part, and a little more where the
        steps of a call of ``add`` do not divide a part
    """

    blocks: th.Tensor
    newest: th.Tensor
    length: th.Tensor

    def __init__(self, names: tuple[str, ...], steps: int, blocks: int = 20) -> None:
        super().__init__()
        self.names = ("steps", *names)
        self.register_buffer("length", th.tensor(float(steps)))
        self.register_buffer("blocks", th.zeros(blocks, len(self.names)))
        self.register_buffer("newest", th.zeros(()))

    def add(self, steps: int, **values: float) -> None:
        """
        Add to the newest block.

        :param steps: steps that have gone by
        :param values: sums over these steps, by name; those left out are zero
        """
        block = self.blocks[int(self.newest)]
        if block[0] >= self.length / len(self.blocks):
            self.newest.add_(1).remainder_(len(self.blocks))
            block = self.blocks[int(self.newest)].zero_()
        row = {**dict.fromkeys(self.names, 0.0), "steps": float(steps), **values}
        block += th.tensor(list(row.values()), device=block.device)

    def __getitem__(self, name: str) -> float:
        """
        Sum over the window.

        :param name: of a quantity, or "steps"
        :return: its sum
        """
        return self.blocks[:, self.names.index(name)].sum().item()
