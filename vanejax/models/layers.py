"""Layers for unordered points, aware of padding.

Group normalisation runs over all real points of one cloud and over the channels of a group (Wu and
He, 2018). It is affine per channel, ``y * scale + shift``: the layers below use that to touch the
large [N, K, C] arrays as rarely as they can.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp

_EPSILON = 1e-5  # PyTorch's default, under which RPM-Net was trained


class GroupNorm(nn.Module):
    """From sums per channel to the affine map that group normalisation amounts to.

    Attributes:
      num_groups: must divide the number of channels.
    """

    num_groups: int

    @nn.compact
    def __call__(
        self, total: jax.Array, total_squared: jax.Array, count: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Scale and shift [C] from sums [C] over ``count`` [] rows of y and of y^2."""
        channels = total.shape[0]
        gain = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))
        size = channels // self.num_groups

        def group_mean(per_channel: jax.Array) -> jax.Array:
            grouped = jnp.sum(per_channel.reshape(self.num_groups, size), axis=1)
            return jnp.repeat(grouped / (count * size), size)

        mean = group_mean(total)
        variance = jnp.maximum(group_mean(total_squared) - mean**2, 0.0)
        scale = gain * jax.lax.rsqrt(variance + _EPSILON)
        return scale, bias - mean * scale


class Linear(nn.Module):
    """The parameters of a dense layer, for callers that need them as arrays."""

    features: int

    @nn.compact
    def __call__(self, channels: int) -> tuple[jax.Array, jax.Array]:
        """Kernel [channels, features] and bias [features]."""
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (channels, self.features))
        return kernel, self.param("bias", nn.initializers.zeros, (self.features,))


class DenseNormRelu(nn.Module):
    """A dense layer on every point, group normalisation, ReLU."""

    features: int
    num_groups: int = 8

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """From x [N, ..., C] with mask [N] to [N, ..., features]."""
        kernel, bias = Linear(self.features, name="dense")(x.shape[-1])
        lead = (1,) * (x.ndim - 1)
        y = x @ kernel + bias.reshape(*lead, -1)
        axes = tuple(range(y.ndim - 1))
        kept = jnp.where(mask.reshape(-1, *(1,) * (y.ndim - 1)), y, 0.0)
        count = jnp.maximum(jnp.sum(mask), 1) * (y[0, ..., 0].size)
        scale, shift = GroupNorm(self.num_groups, name="norm")(
            jnp.sum(kept, axes), jnp.sum(kept * kept, axes), count
        )
        return nn.relu(y * scale.reshape(*lead, -1) + shift.reshape(*lead, -1))


class DenseNormReluMax(nn.Module):
    """`DenseNormRelu`, then the maximum over the axis before the channels, in one.

    Two facts spare the passes over the widest array: the maximum commutes with the normalisation
    (monotone once the sign of the gain is in the kernel), and the sums that the normalisation
    needs follow from the first and second moments of the narrower input.
    """

    features: int
    num_groups: int = 8

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """From x [..., K, C] with mask [..., K] to [..., features]; 0 where no row is real."""
        channels = x.shape[-1]
        kernel, bias = Linear(self.features, name="dense")(channels)
        rows = jnp.where(mask[..., None], x, 0.0).reshape(-1, channels)
        count = jnp.maximum(jnp.sum(mask), 1).astype(x.dtype)
        mean = jnp.sum(rows, 0) / count
        exact = jax.lax.Precision.HIGHEST  # the variance is a difference of these
        second = jnp.matmul(rows.T, rows, precision=exact) / count
        covariance = second - mean[:, None] * mean[None, :]
        mean_y = jnp.matmul(mean, kernel, precision=exact) + bias
        variance_y = jnp.sum(kernel * jnp.matmul(covariance, kernel, precision=exact), 0)
        scale, shift = GroupNorm(self.num_groups, name="norm")(
            mean_y, jnp.maximum(variance_y, 0.0) + mean_y**2, jnp.ones(())
        )
        sign = jnp.where(scale >= 0, 1.0, -1.0)
        signed = kernel * jax.lax.stop_gradient(sign)[None, :]
        top = dense_max(x, signed, mask)
        lead = (1,) * (top.ndim - 1)
        slope = jnp.abs(scale).reshape(*lead, -1)
        return nn.relu(top * slope + (shift + bias * scale).reshape(*lead, -1))


_CHUNK_ROWS = 512  # of x: with its products it stays in a core's cache


def dense_max(x: jax.Array, kernel: jax.Array, mask: jax.Array) -> jax.Array:
    """``max_k (x @ kernel)`` over real rows, without ever writing the product out.

    Args:
      x: [..., K, C] f32.
      kernel: [C, C'] f32.
      mask: [..., K] bool.

    Returns:
      [..., C'] f32, -1e30 where no row is real. In the gradient equal maxima share alike, as in
      `jnp.max`.
    """
    *lead, rows, channels = x.shape
    points = math.prod(lead)
    size = max(1, _CHUNK_ROWS // rows)
    chunks = -(-points // size)
    pad = chunks * size - points
    flat = jnp.pad(x.reshape(points, rows, channels), ((0, pad), (0, 0), (0, 0)))
    real = jnp.pad(mask.reshape(points, rows), ((0, pad), (0, 0)))
    top = _chunked_dense_max(
        flat.reshape(chunks, size, rows, channels), kernel, real.reshape(chunks, size, rows)
    )
    return top.reshape(chunks * size, -1)[:points].reshape(*lead, kernel.shape[1])


@jax.custom_vjp
def _chunked_dense_max(x: jax.Array, kernel: jax.Array, mask: jax.Array) -> jax.Array:
    """From x [chunks, points, K, C] to [chunks, points, C']."""
    return jax.lax.map(lambda chunk: jnp.max(_masked_product(chunk, kernel), -2), (x, mask))


def _masked_product(chunk: tuple[jax.Array, jax.Array], kernel: jax.Array) -> jax.Array:
    x, mask = chunk
    return jnp.where(mask[..., None], x @ kernel, -1e30)


def _dense_max_forward(x: jax.Array, kernel: jax.Array, mask: jax.Array) -> tuple:
    return _chunked_dense_max(x, kernel, mask), (x, kernel, mask)


def _dense_max_backward(saved: tuple, gradient: jax.Array) -> tuple:
    """Recomputes each chunk's product: cheaper than reading it back from memory.

    The maxima are those of this product, not of the forward one: another kernel may round
    differently, and then no row would equal its maximum.
    """
    x, kernel, mask = saved

    def body(d_kernel: jax.Array, chunk: tuple) -> tuple[jax.Array, jax.Array]:
        x, mask, gradient = chunk
        product = _masked_product((x, mask), kernel)
        winner = (product == jnp.max(product, -2, keepdims=True)) & mask[..., None]
        count = jnp.maximum(jnp.sum(winner, -2, dtype=x.dtype), 1.0)
        d_product = jnp.where(winner, (gradient / count)[..., None, :], 0.0)
        d_kernel += jnp.einsum("pkc,pkd->cd", x, d_product)
        return d_kernel, d_product @ kernel.T

    d_kernel, d_x = jax.lax.scan(body, jnp.zeros_like(kernel), (x, mask, gradient))
    return d_x, d_kernel, None


_chunked_dense_max.defvjp(_dense_max_forward, _dense_max_backward)
