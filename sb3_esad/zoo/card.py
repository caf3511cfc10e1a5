"""What a shared agent can do and what it costs, as a card for the Hub."""

import platform
from importlib.metadata import version
from typing import Any

import yaml
from huggingface_hub import EvalResult, ModelCardData
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_esad.common.penalties import kept_limit
from sb3_esad.envs.intervals import poisson_interval
from sb3_esad.report import Figures, format_table
from sb3_esad.zoo.agents import Agent

PACKAGES = ("sb3_esad", "stable_baselines3", "rl_zoo3", "torch", "gymnasium", "highway-env", "numpy")


def model_card(agent: Agent, model: BaseAlgorithm, figures: Figures, seeds: range, repository: str) -> str:
    """
    Describe an agent.

    :param agent: what is shared
    :param model: its model
    :param figures: of its evaluation
    :param seeds: of the episodes on which it was evaluated
    :param repository: where it is shared, as ``organisation/name``
    :return: Markdown with the metadata by which the Hub finds it
    """
    name, env_id = type(model).__name__, agent.env.gym_id
    organisation, repo_name = repository.split("/")
    words = f"--algo {agent.algo} --env {env_id}"
    settings = {**agent.config, **({"env_kwargs": agent.env_kwargs} if agent.env_kwargs else {})}
    return f"""---
{_metadata(agent, figures).to_yaml()}
---

# {name} in {env_id}

{name} of `sb3_esad` on Stable-Baselines3, trained by RL Zoo. {_limit(model, figures)}

## Evaluation

{len(seeds)} episodes with the seeds {seeds[0]} to {seeds[-1]}, by the best action; in brackets 95 % intervals.
If there is a `replay.mp4`, it shows the first.

{format_table({name: figures})}

## Use

With `sb3_esad[zoo]` installed:

```bash
python -m sb3_esad load_from_hub {words} -orga {organisation} -name {repo_name} -f logs
python -m sb3_esad enjoy {words} -f logs
```

## Training

{model.num_timesteps} steps by `python -m sb3_esad train {words} -f logs` with

```yaml
{yaml.safe_dump(settings, sort_keys=True).strip()}
```

Python {platform.python_version()}, {", ".join(f"{package} {version(package)}" for package in PACKAGES)}.
"""


def _limit(model: Any, figures: Figures) -> str:
    """
    Say what was allowed, what was spent and whether the one is within the other, as far as the episodes can tell.

    Student's interval has no width where no episode cost anything, and Poisson's too little where costs come in swarms: the
    wider counts.
    """
    limit, episodes, cost = kept_limit(model), figures["episodes"], figures["cost"]
    least, most = poisson_interval(cost * episodes)
    low, high = min(figures["cost_low"], least / episodes), max(figures["cost_high"], most / episodes)
    spent = f"An episode cost {cost:.3f} [{low:.3f}, {high:.3f}]"
    if limit is None:
        return f"{spent}, without any limit."
    verdict = "kept" if high <= limit else "exceeded" if low > limit else "open, for it lies within the interval"
    return f"{spent}; `cost_limit` allows {limit:g} with `risk_level` {model.risk_level:g}: {verdict}."


def _metadata(agent: Agent, figures: Figures) -> ModelCardData:
    def result(metric: str, figure: str) -> EvalResult:
        value = f"{figures[figure]:.2f} [{figures[f'{figure}_low']:.2f}, {figures[f'{figure}_high']:.2f}]"
        task, env_id = "reinforcement-learning", agent.env.gym_id
        return EvalResult(task, env_id, env_id, metric, value, task_name=task, metric_name=metric)

    metrics = {"mean_reward": "return", "mean_cost": "cost"} | ({"driving_score": "DS"} if "DS" in figures else {})
    return ModelCardData(
        model_name=agent.algo,
        library_name="stable-baselines3",
        tags=[agent.env.gym_id, "reinforcement-learning", "deep-reinforcement-learning", "stable-baselines3", "safe-rl"],
        eval_results=[result(metric, figure) for metric, figure in metrics.items()],
    )
