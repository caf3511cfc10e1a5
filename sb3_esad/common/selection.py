"""Which action is executed: the one that the actor proposes, or a safer one."""

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import torch as th

from sb3_esad.common.agent import LatentAgent
from sb3_esad.common.foresight import Foresight, Outlook
from sb3_esad.common.noise import fixed_seed
from sb3_esad.common.penalties import Penalty
from sb3_esad.common.type_aliases import Belief, Imagination, LatentState, Logs

CALMEST = 2
"""How many samples of the actor and how many uniform actions are imagined where the actor's own action is not admissible."""

LARGEST_CHOICE = 10_000
"""How many states may be imagined and how many actions judged for one decision; whoever shares a model might ask for more."""


class Selection(NamedTuple):
    """
    What is executed in N states.

    :param actions: scaled to [-1, 1], of shape (N, A)
    :param intervened: whether the proposed action was replaced, of shape (N,)
    :param helpless: whether nothing was admissible and the action of least risk was taken, of shape (N,)
    :param risks: Gamma of the proposed action where it was judged, nan elsewhere, of shape (N,)
    """

    actions: th.Tensor
    intervened: th.Tensor
    helpless: th.Tensor
    risks: th.Tensor

    @property
    def judged(self) -> th.Tensor:
        """Whether the proposed action was judged at all, of shape (N,)."""
        return ~self.risks.isnan()


class SelectionRates:
    """How often actions have been judged and replaced lately."""

    names = ("filter_rate", "intervention_rate", "fallback_rate")

    def __init__(self) -> None:
        self._n_actions, self._counts = 0, th.zeros(len(self.names))

    def note(self, selection: Selection) -> None:
        """
        Take note of one step.

        :param selection: of that step
        """
        self._n_actions += len(selection.actions)
        events = th.stack([selection.judged, selection.intervened, selection.helpless])
        self._counts = self._counts.to(events.device) + events.sum(1)

    def take(self) -> Logs:
        """
        Hand over the rates since the last call.

        :return: shares of the actions, empty if there were none
        """
        n_actions, counts = self._n_actions, self._counts.tolist()
        self._n_actions, self._counts = 0, th.zeros(len(self.names))
        return {name: count / n_actions for name, count in zip(self.names, counts, strict=True)} if n_actions else {}


def draw_scenarios(agent: LatentAgent, belief: Belief, n: int) -> LatentState:
    """
    Draw what may be the case: latents of the same memory.

    :param agent: whose world model draws
    :param belief: N states and their observations
    :param n: M, how many for each state, the latent of the state itself first
    :return: fields of shape (M, N, ...)
    """
    state = belief.state
    others = agent.world_model.rssm.head.sample(state.memory, belief.embedding, n - 1) if n > 1 else state.latent[:0]
    latents = th.cat([state.latent, others]).unflatten(0, (n, -1))
    return LatentState(state.memory.expand(n, *state.memory.shape), latents, state.action.expand(n, *state.action.shape))


class ActionFilter(ABC):
    """
    Last word on the action to execute.

    :param settings: of the filter
    """

    @abstractmethod
    def __init__(self, **settings: Any) -> None: ...

    @abstractmethod
    def select(self, agent: LatentAgent, belief: Belief, proposed: th.Tensor) -> Selection:
        """
        Decide what is executed.

        :param agent: whose world model and critics judge
        :param belief: N states and their observations
        :param proposed: the actor's actions, of shape (N, A)
        :return: the actions to execute
        """

    def select_alone(self, agent: LatentAgent, belief: Belief, proposed: th.Tensor) -> Selection:
        """
        Decide likewise, in each state as if there were no others and with the same random numbers each time.

        :param agent: whose world model and critics judge
        :param belief: N states and their observations
        :param proposed: the actor's actions, of shape (N, A)
        :return: the actions to execute
        """
        selections = []
        for place in range(len(proposed)):
            alone = slice(place, place + 1)
            state = LatentState(*(field[alone] for field in belief.state))
            with fixed_seed(proposed.device):
                selections.append(self.select(agent, Belief(state, belief.embedding[alone]), proposed[alone]))
        return Selection(*map(th.cat, zip(*selections, strict=True)))


class NoFilter(ActionFilter):
    """
    Whatever is proposed is executed.

    :param settings: those of :class:`SafetyFilter`, so that either can be built by the same call; ignored
    """

    def __init__(self, **settings: Any) -> None:
        pass

    def select(self, agent: LatentAgent, belief: Belief, proposed: th.Tensor) -> Selection:
        never = th.zeros(len(proposed), dtype=th.bool, device=proposed.device)
        return Selection(proposed, never, never, proposed.new_full((len(proposed),), math.nan))

    select_alone = select


class SafetyFilter(ActionFilter):
    """
    Replaces an action that is not admissible by the most promising one that is, or else by the least risky one.

    Latents drawn from P(z | h, o) are scenarios: an action is as risky as in the worst of them, which are those in which
    critics fear it most; only these are imagined. To choose among latents, as in figure 3 of arXiv 2407.06317, would be to
    choose the world in which there is no car.

    :param penalty: tells what is admissible, and whether the critics may be trusted with that
    :param filter_start: updates of the penalty before which they are not
    :param foresight: imagines where an action leads
    :param risk_level: fraction of the worst scenarios that counts
    :param n_candidates: scenarios of which the critics choose the worst for each action
    :param n_proposals: samples of the actor, and as many uniform actions, that the critics sift where the actor's own action
        is not admissible
    """

    def __init__(
        self,
        penalty: Penalty,
        filter_start: int,
        foresight: Foresight,
        risk_level: float,
        n_candidates: int = 8,
        n_proposals: int = 16,
    ) -> None:
        self.penalty = penalty
        self.filter_start = filter_start
        self.foresight = foresight
        self.risk_level = risk_level
        self.n_candidates = n_candidates
        self.n_proposals = n_proposals

    @th.no_grad()
    def select(self, agent: LatentAgent, belief: Belief, proposed: th.Tensor) -> Selection:
        if not self.penalty.trusts_critics(self.filter_start):
            return NoFilter().select(agent, belief, proposed)
        scenarios = draw_scenarios(agent, belief, self.n_candidates)
        own, _ = self.assess(agent, scenarios, proposed[None])
        refused = ~self._admissible(own)[0]
        actions, helpless = proposed.clone(), th.zeros_like(refused)
        doubtful = refused.nonzero().squeeze(1)  # places, for each mask makes the host wait for a GPU
        if len(doubtful):
            chosen = scenarios.map(lambda field: field[:, doubtful])
            state = belief.state.map(lambda field: field[doubtful])
            known = proposed[doubtful], own.risks[:, doubtful]
            actions[doubtful], helpless[doubtful] = self._choose(agent, chosen, state, *known)
        return Selection(actions, (actions != proposed).any(1), helpless, own.risks[0])

    def assess(self, agent: LatentAgent, scenarios: LatentState, proposals: th.Tensor) -> tuple[Outlook, Imagination]:
        """
        Foresee where actions lead, on average over the scenarios that are the worst for each of them.

        :param agent: whose world model and critics judge
        :param scenarios: fields of shape (M, N, ...)
        :param proposals: P actions for each of N states, of shape (P, N, A)
        :return: how dangerous that is, fields of shape (P, N), and what was imagined, of all scenarios, actions and states
        """
        states = self._worst(agent, scenarios, proposals).map(lambda field: field.flatten(0, 2))
        imagined = self.foresight.imagine(agent, states)
        outlook = self.foresight.outlook(agent, imagined)
        return Outlook(*(_average(field, proposals) for field in outlook)), imagined

    def _worst(self, agent: LatentAgent, scenarios: LatentState, proposals: th.Tensor) -> LatentState:
        """For each action the scenarios in which the critics fear it most, with fields of shape (scenarios, P, N, ...)."""
        shape = (len(scenarios.memory), *proposals.shape[:2])
        states = scenarios.map(lambda field: field[:, None].expand(*shape, *field.shape[2:]))
        states = states._replace(action=proposals.expand(*shape, -1))
        flat = states.map(lambda field: field.flatten(0, 2))
        risks = self.foresight.risk(agent, agent.world_model.features(flat), flat.action).view(shape)
        worst = risks.topk(math.ceil(self.risk_level * shape[0]), dim=0).indices
        return states.map(lambda field: field.take_along_dim(worst.view(*worst.shape, *[1] * (field.dim() - 3)), dim=0))

    def _admissible(self, outlook: Outlook) -> th.Tensor:
        # Both by the same bound: where the budget is nearly 0, critics never expect so little
        return self.penalty.admissible(outlook.risks, self.foresight.barrier(outlook, self.penalty.budget_scale))

    def _choose(
        self, agent: LatentAgent, scenarios: LatentState, state: LatentState, refused: th.Tensor, risks: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Instead of the refused action the best of others that are admissible; if none is, of all the least risky one."""
        others = self._proposals(agent, state)
        outlook, imagined = self.assess(agent, scenarios, others)
        values = _average(self.foresight.values(agent, imagined), others)
        admissible = self._admissible(outlook)
        helpless = ~admissible.any(0)
        promising = 1 + values.masked_fill(~admissible, -math.inf).argmax(0)
        best = th.where(helpless, th.cat([risks, outlook.risks]).argmin(0), promising)
        return th.cat([refused[None], others])[best, th.arange(len(refused), device=best.device)], helpless

    def _proposals(self, agent: LatentAgent, state: LatentState) -> th.Tensor:
        """Of samples of the actor and of uniform actions those that the critics fear least, of shape (P, N, A)."""
        grids = agent.world_model.features(state)
        samples = agent.actor(grids.repeat(self.n_proposals, 1, 1, 1)).unflatten(0, (self.n_proposals, -1))
        actions = th.stack([samples, 2 * th.rand_like(samples) - 1])
        risks = self.foresight.risk(agent, grids.repeat(2 * self.n_proposals, 1, 1, 1), actions.flatten(0, 2))
        calmest = risks.view(actions.shape[:3]).topk(CALMEST, dim=1, largest=False).indices
        chosen = actions.gather(1, calmest[..., None].expand(-1, -1, -1, samples.shape[-1]))
        return chosen.flatten(0, 1)


def _average(field: th.Tensor, proposals: th.Tensor) -> th.Tensor:
    """Over scenarios, which come first in a flat field of all scenarios, actions and states; of shape (P, N)."""
    return field.view(-1, *proposals.shape[:2]).mean(0)
