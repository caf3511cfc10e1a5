"""The optimiser of all networks: orthogonalised momentum for weight matrices, Adam for the rest."""

from collections.abc import Callable, Iterable
from typing import Any

import torch as th

MIN_RANK = 16
"""A matrix with fewer rows or columns, such as a head with a single output, is left to Adam."""


class MuonWithAdam(th.optim.Optimizer):
    """
    Muon (K. Jordan et al. 2024) for weight matrices and kernels, Adam for biases, gains and small heads, at one learning rate.

    Muon's steps are scaled to the size of Adam's (arXiv 2502.16982, Eq. 4). The gain is measured in docs/experiments.md,
    section 5: a world model learns in 300 updates what takes Adam more than 1,000.

    :param params: parameters of one network
    :param lr: learning rate
    :param momentum: of Muon
    :param betas: decay rates of Adam's averages
    """

    def __init__(
        self,
        params: Iterable[th.nn.Parameter],
        lr: float = 5e-3,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.99),
    ) -> None:
        parameters = list(params)
        super().__init__(parameters, {"lr": lr})
        self.matrices = [p for p in parameters if p.dim() > 1 and min(p.shape[0], p[0].numel()) >= MIN_RANK]
        rest = [p for p in parameters if not any(p is matrix for matrix in self.matrices)]
        # Kernels become matrices with a row for each output channel
        self.flat = [th.nn.Parameter(matrix.detach().flatten(1).clone()) for matrix in self.matrices]
        self.parts: list[th.optim.Optimizer] = []
        if self.flat:
            self.parts.append(th.optim.Muon(self.flat, lr, 0.0, momentum, adjust_lr_fn="match_rms_adamw"))
        if rest:
            self.parts.append(th.optim.Adam(rest, lr, betas, fused=True))

    @th.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """
        Move the parameters against their gradients.

        :param closure: not used
        """
        for flat, matrix in zip(self.flat, self.matrices, strict=True):
            # Read anew at each step, for the network may have been loaded, or moved to another device
            flat.data = matrix.flatten(1).clone()
            flat.grad = None if matrix.grad is None else matrix.grad.flatten(1)
        for part in self.parts:
            for group in part.param_groups:
                group["lr"] = self.param_groups[0]["lr"]
            part.step()
        for flat, matrix in zip(self.flat, self.matrices, strict=True):
            matrix.copy_(flat.view(matrix.shape))

    def state_dict(self) -> dict[str, Any]:
        """
        Give what must be saved to go on.

        :return: the states of both parts, and the settings
        """
        return {**super().state_dict(), "parts": [part.state_dict() for part in self.parts]}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """
        Go on from a saved state.

        :param state_dict: what :meth:`state_dict` gave
        """
        super().load_state_dict({key: value for key, value in state_dict.items() if key != "parts"})
        for part, state in zip(self.parts, state_dict["parts"], strict=True):
            part.load_state_dict(state)
