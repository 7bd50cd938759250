"""The bridge to JAX: batches as JAX arrays, plans and their loss with gradients."""

from cnpgen.errors import requires_extra

with requires_extra("jax", "jax"):
    from cnpgen.interop.jax.jax_batches import to_jax
    from cnpgen.interop.jax.jax_plans import control_points, plan_loss

__all__ = ["control_points", "plan_loss", "to_jax"]
