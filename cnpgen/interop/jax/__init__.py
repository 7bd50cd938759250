"""The bridge to JAX: batches as its arrays, plans and their loss with gradients."""

from cnpgen.interop.jax.batches import to_jax
from cnpgen.interop.jax.plans import control_points, plan_loss

__all__ = ["control_points", "plan_loss", "to_jax"]
