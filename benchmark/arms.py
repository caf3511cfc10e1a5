"""The experiments of docs/experiments.md: what each asks, where, of which arms or scripts; ``experiments.py`` runs them."""

from typing import Any, NamedTuple

from variants import VARIANTS

IMAGINING = ("esad_lend", "sad_len", "ad_end", *VARIANTS)
HIGHWAY, JUNCTION, BRAKING = "esad-highway-v0", "esad-traffic-negotiation-v0", "esad-braking-v0"
SITUATIONS = (HIGHWAY, JUNCTION, "esad-obstacle-avoidance-v0", BRAKING)


class Arm(NamedTuple):
    """
    One side of an experiment.

    :param algorithm: key of ``ALGORITHMS`` in benchmark/driving.py
    :param changes: arguments of its constructor to replace
    :param few_updates: as the demo has them, for those that imagine; else as in hyperparams/, four times as many
    """

    algorithm: str
    changes: dict[str, Any]
    few_updates: bool = True


class Experiment(NamedTuple):
    """
    A question that trainings answer.

    :param question: in words
    :param envs: scenarios
    :param arms: by name, the first is what the others are compared with
    :param steps: of each training
    """

    question: str
    envs: tuple[str, ...]
    arms: dict[str, Arm]
    steps: int = 20_000


def diffusion(steps: int) -> dict[str, Any]:
    """
    Set the steps of the latent's diffusion.

    :param steps: K
    :return: arguments of the constructor
    """
    return {"policy_kwargs": {"head_kwargs": {"diffusion_steps": steps}}}


def temperature(factor: float) -> dict[str, Any]:
    """
    Set the temperature of dreams.

    :param factor: of the prior's spread
    :return: arguments of the constructor
    """
    return {"policy_kwargs": {"head_kwargs": {"temperature": factor}}}


RECORDED: dict[str, Any] = {
    "replay_cost_critic_coef": 10.0,
    "replay_lambda": 0.95,
    "min_cost_critic_rate": 1 / 3,
}
"""As with the settings of hyperparams/, which the demo's budget replaces."""
FILTER: dict[str, Any] = {"filter_start": 300}
BARRIER: dict[str, Any] = {"barrier_coef": 1.0}
EXPERIMENTS = {
    "E2": Experiment(
        "Risk with or without the bound that costs are never negative?",
        (HIGHWAY,),
        {"capped": Arm("esad_lend", {}), "Gaussian": Arm("gaussian_risk", {})},
    ),
    "E3": Experiment(
        "What moves the multiplier?",
        (HIGHWAY,),
        {"both": Arm("esad_lend", {}), "critics": Arm("critics_only", {}), "road": Arm("road_only", {})},
    ),
    "E4": Experiment(
        "How many steps of diffusion?",
        (HIGHWAY, JUNCTION),
        {f"K = {steps}": Arm("esad_lend", diffusion(steps)) for steps in (0, 1, 2, 3)},
    ),
    "E5": Experiment(
        "Does the filter prevent collisions, and the barrier?",
        (HIGHWAY, BRAKING),
        {
            "neither": Arm("esad_lend", {}, few_updates=False),
            "filter": Arm("esad_lend", FILTER, few_updates=False),
            "barrier": Arm("esad_lend", BARRIER, few_updates=False),
            "both": Arm("esad_lend", {**FILTER, **BARRIER}, few_updates=False),
        },
        steps=15_000,
    ),
    "E6": Experiment(
        "How much entropy?",
        (HIGHWAY,),
        {f"target {target}": Arm("esad_lend", {"target_entropy": target}) for target in (-2.0, -1.0, 0.0)},
    ),
    "E7": Experiment(
        "Are recorded costs needed, and more of them than there were?",
        (HIGHWAY,),
        {
            "both": Arm("esad_lend", {}),
            "critics from imagination alone": Arm("esad_lend", {"replay_cost_critic_coef": 0.0}),
            "above all recorded windows": Arm("esad_lend", RECORDED),
            "no more costs than there were": Arm("esad_lend", {"replay_buffer_kwargs": {"event_fraction": 0.0}}),
        },
    ),
    "E9": Experiment(
        "Ahead of algorithms without a model?",
        (HIGHWAY, BRAKING),
        {
            "all updates": Arm("esad_lend", {}, few_updates=False),
            "few updates": Arm("esad_lend", {}),
            **{name: Arm(name, {}) for name in ("sac", "sac_lag", "wcsac")},
        },
        steps=15_000,
    ),
    "recency": Experiment(
        "Shall what is newer be drawn more often?",
        (HIGHWAY, BRAKING),
        {"newer": Arm("esad_lend", {}), "all alike": Arm("esad_lend", {"replay_buffer_kwargs": {"recency": 0.0}})},
    ),
    "crawl": Experiment(
        "Why does it crawl where cars brake?",
        (BRAKING,),
        {
            "as it is": Arm("esad_lend", {}, few_updates=False),
            "steady model": Arm("steady_model", {}, few_updates=False),
            "temperature 0.5": Arm("steady_model", temperature(0.5), few_updates=False),
            "temperature 0": Arm("steady_model", temperature(0.0), few_updates=False),
            "looks 4 s ahead": Arm("steady_model", {"cost_gamma": 0.95}, few_updates=False),
        },
        steps=15_000,
    ),
    "ablations": Experiment(
        "What are diffusion and safety worth?",
        SITUATIONS,
        {
            "ESAD-LEND": Arm("esad_lend", {**diffusion(2), **FILTER, **BARRIER}, few_updates=False),
            "SAD-LEN": Arm("sad_len", {**FILTER, **BARRIER}, few_updates=False),
            "AD-END": Arm("ad_end", {}, few_updates=False),
        },
        steps=15_000,
    ),
}
SCRIPTS: dict[str, list[list[str]]] = {
    "E0": [["diffusion.py", "--env", env_id] for env_id in (BRAKING, JUNCTION, HIGHWAY, "esad-course-2mps-v0")],
    "E1": [
        ["driving.py", "esad_lend", "--few-updates", "--save-buffer", "--out", "runs/E1"],
        ["variance_loss.py", "runs/E1/esad_lend_0.zip", "runs/E1/esad_lend_0.pkl"],
    ],
    "E8": [["driving.py", "esad_lend", "--seed", seed, "--out", "runs/E8"] for seed in ("0", "10", "20")],
    "E10": [["world_model.py"]],
}
"""Experiments that are no comparison of trainings: what is run one after the other."""
