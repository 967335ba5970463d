"""Policy optimization by gradients through the simulation, on one machine or on many.

>>> from functools import partial
>>> make = partial(dc.envs.make, "FoldCloth", size=12, opens_at=-1, reach=0.06)
>>> trainer = dc.learn.Trainer(make, dc.learn.TrainerOptions(), num_envs=8)
>>> for _ in range(100):
...     log = trainer.update()
"""

from diffcloth_torch.learn.demonstrations import record
from diffcloth_torch.learn.evaluation import Episodes, evaluate
from diffcloth_torch.learn.imitation import imitate
from diffcloth_torch.learn.options import TrainerOptions
from diffcloth_torch.learn.plans import Plans, plan
from diffcloth_torch.learn.policy import Policy, PolicySizes, load_policy
from diffcloth_torch.learn.trainer import Trainer
from diffcloth_torch.learn.workers import Jobs, Processes, Ranks, RayActors, Workers

__all__ = [
    "Episodes",
    "Jobs",
    "Plans",
    "Policy",
    "PolicySizes",
    "Processes",
    "Ranks",
    "RayActors",
    "Trainer",
    "TrainerOptions",
    "Workers",
    "evaluate",
    "imitate",
    "load_policy",
    "plan",
    "record",
]
