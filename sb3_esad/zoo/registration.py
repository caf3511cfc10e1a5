"""Our algorithms in the tables of RL Zoo, and what knows of costs in place of what does not."""

from functools import partial

from rl_zoo3 import exp_manager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.common.callbacks import CostEvalCallback
from sb3_esad.zoo.search import convert, sample
from sb3_esad.zoo.trials import ConstrainedTrialCallback


def register() -> None:
    """
    Make all algorithms known to RL Zoo; to do so twice changes nothing.

    RL Zoo imports a module ``custom_envs`` before it does anything else. Some of its scripts do so in the midst of importing
    their experiment manager; these only load models, and so need no manager of ours.
    """
    for name, algorithm in ALGORITHMS.items():
        ALGOS[name] = algorithm
        HYPERPARAMS_SAMPLER[name] = partial(sample, algorithm)
        HYPERPARAMS_CONVERTER[name] = convert
    if hasattr(exp_manager, "ExperimentManager"):
        from sb3_esad.zoo.manager import CostAwareManager

        # RL Zoo looks these names up whenever it needs them
        vars(exp_manager).update(
            ExperimentManager=CostAwareManager,
            EvalCallback=CostEvalCallback,
            TrialEvalCallback=ConstrainedTrialCallback,
        )
