"""The optimiser of all networks: orthogonalised momentum for weight matrices, Adam for the rest."""

from collections.abc import Callable, Iterable
from typing import Any

import torch as th

MIN_RANK = 16
"""A matrix with fewer rows or columns, such as a head with a single output or a layer on an action, is left to Adam."""


class MuonWithAdam(th.optim.Optimizer):
    """
    Muon (K. Jordan et al. 2024) for weight matrices and kernels, Adam for biases, gains and small layers, at one rate.

    Muon's steps are scaled to the size of Adam's (arXiv 2502.16982, Eq. 4). The gain is measured in docs/experiments.md,
    section 5, at equal time.

    :param params: parameters of one network, in a single group
    :param lr: learning rate
    :param momentum: of Muon
    :param betas: decay rates of Adam's averages
    """

    def __init__(
        self,
        params: Iterable[th.nn.Parameter],
        lr: float,
        momentum: float = 0.95,
        betas: tuple[float, float] = (0.9, 0.99),
    ) -> None:
        super().__init__(params, {"lr": lr})
        parameters = self.param_groups[0]["params"]
        self.matrices = [p for p in parameters if _is_matrix(p)]
        # Kernels become matrices with a row for each output channel
        self.flat = [th.nn.Parameter(matrix.detach().flatten(1).clone()) for matrix in self.matrices]
        rest = [p for p in parameters if not _is_matrix(p)]
        self.parts: list[th.optim.Optimizer] = []
        if self.flat:
            self.parts.append(th.optim.Muon(self.flat, lr, 0.0, momentum, adjust_lr_fn="match_rms_adamw"))
        if rest:
            self.parts.append(th.optim.Adam(rest, lr, betas, fused=True))

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """
        Take the parameters of the constructor, and no others.

        :param param_group: parameters and settings
        :raises ValueError: at a second group
        """
        if self.param_groups:
            raise ValueError("MuonWithAdam has one group of parameters; make an optimiser for each group instead.")
        super().add_param_group(param_group)

    @th.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """
        Move the parameters against their gradients.

        :param closure: computes the loss and its gradients anew
        :return: the loss, if there is a closure
        """
        loss = None
        if closure is not None:
            with th.enable_grad():
                loss = closure()
        self._read_weights()
        for flat, matrix in zip(self.flat, self.matrices, strict=True):
            flat.grad = None if matrix.grad is None else matrix.grad.flatten(1)
        for part in self.parts:
            for group in part.param_groups:
                group["lr"] = self.param_groups[0]["lr"]
            part.step()
        for flat, matrix in zip(self.flat, self.matrices, strict=True):
            matrix.copy_(flat.view(matrix.shape))
            flat.grad = None
        return loss

    @th.no_grad()
    def _read_weights(self) -> None:
        """Follow the network, which may have been loaded or moved to another device in the meantime."""
        for flat, matrix in zip(self.flat, self.matrices, strict=True):
            flat.data = matrix.flatten(1).clone()

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
        :raises ValueError: if it is the state of another optimiser
        """
        if "parts" not in state_dict:
            raise ValueError("This is no state of MuonWithAdam: use the optimizer_class that the model was trained with.")
        super().load_state_dict({key: value for key, value in state_dict.items() if key != "parts"})
        self._read_weights()  # for Muon keeps its momentum where the weights are
        for part, state in zip(self.parts, state_dict["parts"], strict=True):
            part.load_state_dict(state)
            refuse_misshapen_state(part)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "matrices": self.matrices, "flat": self.flat, "parts": self.parts}


def differentiate(loss: th.Tensor, optimizer: th.optim.Optimizer) -> None:
    """
    Compute the gradient of a loss for the parameters of one network; whatever else it passed through, or is frozen, has none.

    :param loss: scalar
    :param optimizer: of the network
    """
    optimizer.zero_grad()
    parameters = (parameter for group in optimizer.param_groups for parameter in group["params"])
    loss.backward(inputs=[parameter for parameter in parameters if parameter.requires_grad])


def refuse_misshapen_state(optimizer: th.optim.Optimizer) -> None:
    """
    Refuse, and forget, averages that are not of the shape of their parameter: torch's fused kernels write beyond their end.

    :param optimizer: whose state was loaded
    :raises ValueError: if a state belongs to no parameter, or has another shape
    """
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            shape = th.Size() if name == "step" else getattr(parameter, "shape", None)
            if isinstance(value, th.Tensor) and value.shape != shape:
                optimizer.state.clear()
                raise ValueError(f"The state {name!r} has the shape {tuple(value.shape)}: load one of the same networks.")


def _is_matrix(parameter: th.nn.Parameter) -> bool:
    return parameter.dim() > 1 and min(parameter.shape[0], parameter[0].numel()) >= MIN_RANK
