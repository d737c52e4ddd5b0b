"""`jax.jit` for programs that run for milliseconds: a fifth of the time to compile, slower code.

Only for the outermost function: options cannot be nested. Not for gradients of `jnp.max`, which
looks for the maximum anew among numbers that are then rounded otherwise.
"""

import functools

import jax

OPTIONS = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
quick_jit = functools.partial(jax.jit, compiler_options=OPTIONS)
