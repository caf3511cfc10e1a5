"""One moment of an episode as a picture: what happens, and what a model makes of it."""

import math
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th

from sb3_esad.common.selection import NoFilter
from sb3_esad.dream import DreamingDriver
from sb3_esad.esad_lend import ESADLEND
from sb3_esad.explanation import ExplainedDriver
from sb3_esad.panels import BAD, FAINT, GOOD, MARK, Colour, Gauge, Picture, compose, paint

SMALLEST_RISK = 1e-4
DREAM = "A dream goes on from memory, given the actions really taken."
FUTURES = "Futures start from what may be the case now, with the action chosen; the actor goes on in each of them."


class Moment(NamedTuple):
    """
    What a frame shows of an episode.

    :param env: scenario, to be rendered
    :param observation: what the model has just been shown
    :param info: of the step before
    :param cost: of the episode so far
    :param verdict: how the episode ended, empty as long as it goes on
    """

    env: gym.Env[Any, Any]
    observation: Any
    info: dict[str, Any]
    cost: float
    verdict: str


def dreaming_frame(moment: Moment, driver: DreamingDriver) -> Picture:
    """
    Show a moment beside what the model remembers and dreams of it.

    :param moment: what happens
    :param driver: who has just chosen an action in it
    :return: RGB picture
    """
    blind = driver.blind_steps / moment.env.metadata["render_fps"]
    dream = f"What it dreams, {blind:.1f} s without looking" if blind else "What it dreams, eyes open"
    panels = {
        "What it sees": paint(image_of(moment.observation) / 255.0),
        "What it remembers of it": _picture(driver.reconstruction()),
        dream: _picture(driver.dream()),
    }
    gauges = [
        _speed(moment),
        _cost(moment, driver.model),
        _risk(driver.model, "predicted risk", driver.risk()),
        _route(moment),
    ]
    return compose(render(moment.env), panels, gauges, moment.verdict, DREAM)


def explaining_frame(moment: Moment, driver: ExplainedDriver) -> Picture:
    """
    Show a moment beside what the model thinks possible, how dangerous that is, and whether its filter has stepped in.

    :param moment: what happens
    :param driver: who has just chosen an action in it
    :return: RGB picture
    """
    futures, ahead = driver.futures(), driver.horizon / moment.env.metadata["render_fps"]
    panels = {
        "What it sees": paint(image_of(moment.observation) / 255.0),
        "What it remembers": _picture(driver.reconstruction()),
    }
    word, colour = _verdict_of_filter(driver)
    panels[word] = np.full((80, 160, 3), colour, dtype=np.uint8)
    places = {"most dangerous": 0, "middle": len(futures.costs) // 2, "least dangerous": len(futures.costs) - 1}
    for name, place in places.items():
        title = f"In {ahead:.0f} s, {name} of {len(futures.costs)}: cost {100 * futures.costs[place]:.1f} %"
        panels[title] = _picture(futures.images, place)
    mean, tail = futures.costs.mean().item(), driver.tail(futures)
    gauges = [
        _speed(moment),
        _risk(driver.model, "risk of the action", driver.risk),
        _judgement(driver) if driver.selection.judged else _risk(driver.model, "mean of the futures", mean),
        _risk(driver.model, "worst of the futures", tail),
    ]
    return compose(render(moment.env), panels, gauges, moment.verdict, FUTURES)


def _judgement(driver: ExplainedDriver) -> Gauge:
    """What the filter has foreseen of the action that the actor proposed, beside the most that it admits."""
    risk, allowed = driver.selection.risks.item(), driver.model.penalty.budget_scale
    label, colour = f"as the filter judged the actor's, at most {100 * allowed:.2f} %", BAD if risk > allowed else GOOD
    return Gauge(label, f"{100 * risk:.1f} %", _risk_share(risk), _risk_share(allowed), colour)


def _verdict_of_filter(driver: ExplainedDriver) -> tuple[str, Colour]:
    if isinstance(driver.model.policy.action_filter, NoFilter):
        return "It has no filter", FAINT
    if not driver.selection.judged:
        return "Filter: at rest, for its critics are not trusted", FAINT
    if driver.selection.helpless:
        return "Filter: nothing is safe, least risk taken", BAD
    return ("Filter: another action taken", MARK) if driver.selection.intervened else ("Filter: the actor's own action", GOOD)


def _speed(moment: Moment) -> Gauge:
    speed, config = moment.info["speed"], moment.env.unwrapped.config  # type: ignore[attr-defined]
    shares = (speed / config["max_speed"], config["target_speed"] / config["max_speed"])
    return Gauge("speed, target marked", f"{speed:.1f} m/s", *shares, GOOD)


def _cost(moment: Moment, model: ESADLEND) -> Gauge:
    cost = float(moment.info.get(model.cost_key, 0.0))
    return Gauge("cost of this step", f"{round(cost, 2):g}   episode {round(moment.cost, 2):g}", cost, None, BAD)


def _risk(model: ESADLEND, name: str, risk: float) -> Gauge:
    limited, budget = model.penalty.cost_limit is not None, model.penalty.budget
    allowed = f"budget {100 * budget:.2f} %" if limited else "no limit"
    mark = _risk_share(budget) if limited else None
    colour = BAD if limited and risk > budget else GOOD
    return Gauge(f"{name}, {allowed}", f"{100 * risk:.1f} %", _risk_share(risk), mark, colour)


def _route(moment: Moment) -> Gauge:
    driven = 1 - moment.env.unwrapped.remaining  # type: ignore[attr-defined]
    return Gauge("route driven", f"{100 * driven:.0f} %", driven, None, GOOD)


def _picture(images: dict[str, th.Tensor], index: int = 0) -> Picture:
    return paint(image_of(images)[index].cpu().numpy())


def _risk_share(risk: float) -> float:
    """Place on a logarithmic scale from 0.01 % to 100 %: a budget of 1 % must be told from none."""
    return 1 - math.log10(min(max(risk, SMALLEST_RISK), 1.0)) / math.log10(SMALLEST_RISK)


def image_of(observation: Any) -> Any:
    """
    Find the image in an observation or reconstruction.

    :param observation: of any type
    :return: the image, None if there is none
    """
    if isinstance(observation, dict):
        return observation.get("image", observation.get("observation"))
    return observation if np.ndim(observation) == 3 else None


def render(env: gym.Env[Any, Any]) -> Picture:
    """
    Show a scenario as a person sees it.

    :param env: in the mode ``rgb_array``
    :return: RGB picture
    """
    picture = env.render()
    assert isinstance(picture, np.ndarray)
    return picture
