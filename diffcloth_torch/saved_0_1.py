"""Files and names of 0.1: one table of old names, and the loaders of its checkpoints."""

from __future__ import annotations

__all__ = ["OPTIONS"]

OPTIONS = {
    "actor_rate": "learning_rate",
    "critic_rate": "critic_learning_rate",
    "deviation": "init_std",
    "gradient_norm": "max_grad_norm",
    "plan_rate": "plan_learning_rate",
    "target_rate": "tau",
    "temperature_rate": "temperature_learning_rate",
    "trace": "gae_lambda",
}
"""Option of `TrainerOptions` in 0.1 -> its name."""
