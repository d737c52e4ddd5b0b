"""Layers for unordered points, aware of padding.

Group normalisation over all real points of one cloud and the channels of a group (Wu and He, 2018)
is affine per channel, ``y * scale + shift``; both follow from each channel's mean and variance. The
layers differ in where they take those from, and in what they spare the large [N, K, C] arrays.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from vanejax.matching.se3 import matmul

_EPSILON = 1e-5  # PyTorch's default, under which RPM-Net was trained


class Linear(nn.Module):
    """The parameters of a dense layer, for callers that need them as arrays."""

    features: int

    @nn.compact
    def __call__(self, channels: int) -> tuple[jax.Array, jax.Array]:
        """Kernel [channels, features] and bias [features]."""
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (channels, self.features))
        return kernel, self.param("bias", nn.initializers.zeros, (self.features,))


class GroupNorm(nn.Module):
    """The affine map that group normalisation of C = ``features`` channels amounts to."""

    features: int
    num_groups: int

    def setup(self) -> None:
        """Gain and bias [C]."""
        self.gain = self.param("scale", nn.initializers.ones, (self.features,))
        self.bias = self.param("bias", nn.initializers.zeros, (self.features,))

    def sign(self) -> jax.Array:
        """[C], -1 where the map falls, else 1: the sign of its scale; a constant."""
        return jnp.where(self.gain >= 0, 1.0, -1.0).astype(self.gain.dtype)

    def __call__(
        self, mean: jax.Array, variance: jax.Array, offset: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Scale and shift [C] that normalise ``y + offset``, from mean and variance [C] of y.

        The dense layer's bias is the offset: left out of y, it costs the variance no digits.
        """
        size = self.features // self.num_groups

        def over_group(per_channel: jax.Array) -> jax.Array:
            return jnp.repeat(jnp.mean(per_channel.reshape(self.num_groups, size), axis=1), size)

        center = over_group(mean + offset)
        spread = over_group(jnp.maximum(variance, 0.0) + (mean + offset - center) ** 2)
        scale = self.gain * jax.lax.rsqrt(spread + _EPSILON)
        return scale, self.bias + (offset - center) * scale


class NormedLayer(nn.Module):
    """A dense layer's parameters and its group normalisation, which divides ``features``."""

    features: int
    num_groups: int = 8

    def parts(self, channels: int) -> tuple[jax.Array, jax.Array, GroupNorm]:
        """Kernel [channels, features], bias [features] and the normalisation."""
        kernel, bias = Linear(self.features, name="dense")(channels)
        return kernel, bias, GroupNorm(self.features, self.num_groups, name="norm")


class DenseNormRelu(NormedLayer):
    """A dense layer on every point, group normalisation, ReLU."""

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """From x [N, C] or [N, K, C] with mask [N] to [..., features]."""
        return norm_relu(x, *self.parts(x.shape[-1]), mask)


def norm_relu(
    x: jax.Array, kernel: jax.Array, bias: jax.Array, norm: GroupNorm, mask: jax.Array
) -> jax.Array:
    """ReLU of the normalised ``x @ kernel + bias``, see `DenseNormRelu`.

    For x much narrower than the product, the moments of x give the product's and the normalisation
    goes into the kernel: the product is written once, as the answer.
    """
    lead = (1,) * (x.ndim - 1)
    if 2 * x.shape[-1] <= kernel.shape[1]:
        scale, shift = norm(*product_moments(x, kernel, mask), bias)
        return nn.relu(product(x, kernel * scale[None, :]) + shift.reshape(*lead, -1))
    y = product(x, kernel)
    total, squared = (y, y * y) if y.ndim == 2 else (jnp.sum(y, 1), jnp.sum(y * y, 1))
    scale, shift = norm(*_moments_of_sums(total, squared, mask, y.size // total.size), bias)
    return nn.relu(y * scale.reshape(*lead, -1) + shift.reshape(*lead, -1))


class DenseNormReluMax(NormedLayer):
    """`DenseNormRelu`, then the maximum over the neighbours.

    It commutes with a map that is monotone per channel; where the map falls, the kernel's sign is
    turned first.
    """

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """From x [N, K, C] with mask [N] to [N, features]."""
        kernel, bias, norm = self.parts(x.shape[-1])
        top, squared = neighbor_sums(product(x, kernel * norm.sign()[None, :]))
        total = product(jnp.sum(x, 1), kernel)
        scale, shift = norm(*_moments_of_sums(total, squared, mask, x.shape[1]), bias)
        return nn.relu(top * jnp.abs(scale)[None, :] + shift[None, :])


class DenseNormReluCloudMax(NormedLayer):
    """`DenseNormRelu`, then the maximum over all points of the cloud."""

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """From x [N, C] with mask [N] to [features]; 0 where no point is real."""
        kernel, bias, norm = self.parts(x.shape[-1])
        scale, shift = norm(*product_moments(x, kernel, mask), bias)
        top = cloud_max(x, kernel * norm.sign()[None, :], mask)
        return nn.relu(top * jnp.abs(scale) + shift)


def _moments_of_sums(
    total: jax.Array, squared: jax.Array, mask: jax.Array, rows: int
) -> tuple[jax.Array, jax.Array]:
    """Mean and variance [C] of y from the sums [N, C] of y and y^2 over the rows of each point."""
    count = rows * jnp.maximum(jnp.sum(mask), 1)
    mean = jnp.sum(total, 0, where=mask[:, None]) / count
    return mean, jnp.sum(squared, 0, where=mask[:, None]) / count - mean**2


def product_moments(
    x: jax.Array, kernel: jax.Array, mask: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Mean and variance [C'] of ``x @ kernel`` over real rows, from the moments of x.

    x is [N, C] or [N, K, C], the kernel [C, C'], the mask [N]. Exact products, since variances are
    differences.
    """
    real = mask.reshape(-1, *(1,) * (x.ndim - 1))
    rows = jnp.where(real, x, 0.0).reshape(-1, x.shape[-1])
    count = jnp.maximum(jnp.sum(mask), 1) * (rows.shape[0] // x.shape[0])
    mean = jnp.sum(rows, 0) / count
    second = matmul(rows.T, rows) / count
    covariance = second - mean[:, None] * mean[None, :]
    spread = matmul(covariance, kernel)
    return matmul(mean, kernel), jnp.sum(kernel * spread, 0)


@jax.custom_vjp
def product(x: jax.Array, kernel: jax.Array) -> jax.Array:
    """``x @ kernel`` of x [..., C] with kernel [C, C'].

    Its gradient multiplies in the order that copies the narrower of two large arrays.
    """
    return x @ kernel


def _product_forward(x: jax.Array, kernel: jax.Array) -> tuple:
    return x @ kernel, (x, kernel)


def _product_backward(saved: tuple, d_y: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = saved
    rows, d_rows = x.reshape(-1, x.shape[-1]), d_y.reshape(-1, d_y.shape[-1])
    return (d_rows @ kernel.T).reshape(x.shape), rows.T @ d_rows


product.defvjp(_product_forward, _product_backward)


@jax.custom_vjp
def neighbor_sums(y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Maximum of y [N, K, C] and sum of y^2 over the neighbours, [N, C] each.

    In the gradient equal maxima share alike, as in `jnp.max`.
    """
    return jnp.max(y, 1), jnp.sum(y * y, 1)


def _sums_forward(y: jax.Array) -> tuple:
    top, squared = neighbor_sums(y)
    return (top, squared), (y, top)


def _sums_backward(saved: tuple, cotangents: tuple) -> tuple[jax.Array]:
    """One pass to count the winners and one for the gradient."""
    y, top = saved
    d_top, d_squared = cotangents
    winner = y == top[:, None, :]
    share = d_top / jnp.sum(winner, 1, dtype=jnp.int32)
    d_y = jnp.where(winner, share[:, None, :], 0.0)
    return (d_y + 2.0 * d_squared[:, None, :] * y,)


neighbor_sums.defvjp(_sums_forward, _sums_backward)


@jax.custom_vjp
def cloud_max(x: jax.Array, kernel: jax.Array, mask: jax.Array) -> jax.Array:
    """``max_n (x @ kernel)`` [C'] over real rows of x [N, C]; -1e30 where no row is real.

    The gradient goes to the last of several equal maxima, and costs the C' winning rows instead of
    two products of the whole.
    """
    return _cloud_max_forward(x, kernel, mask)[0]


def _cloud_max_forward(x: jax.Array, kernel: jax.Array, mask: jax.Array) -> tuple:
    x, mask = jnp.asarray(x), jnp.asarray(mask)  # a tracer indexes them in the backward pass
    y = jnp.where(mask[:, None], x @ kernel, -1e30)
    top = jnp.max(y, 0)
    place = jnp.arange(len(y), dtype=jnp.int32)[:, None]
    return top, (x, kernel, mask, jnp.max(jnp.where(y == top[None, :], place, 0), 0))


def _cloud_max_backward(saved: tuple, d_top: jax.Array) -> tuple:
    x, kernel, mask, winner = saved
    d_top = jnp.where(mask[winner], d_top, 0.0)  # where no row is real
    d_x = jnp.zeros_like(x).at[winner].add((kernel * d_top[None, :]).T)
    return d_x, (x[winner] * d_top[:, None]).T, None


cloud_max.defvjp(_cloud_max_forward, _cloud_max_backward)
