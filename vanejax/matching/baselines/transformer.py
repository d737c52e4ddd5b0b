"""A transformer of one encoder and one decoder block between two point clouds, as in DCP.

The published network is the "Annotated Transformer": every sublayer is ``x + f(norm(x))``, encoder
and decoder end in a norm of their own, without positions or dropout. What depends on one cloud
alone, `Encoded`, is computed once per cloud: it serves both directions and many scans of a part.
"""

from __future__ import annotations

from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from vanejax.matching.se3 import safe_sqrt

_EPSILON = 1e-6  # added to the standard deviation, as published
_MASKED = -1e9  # its exponential is exactly zero beside any real score


class Encoded(NamedTuple):
    """What a cloud [N] brings to a pairing with any other; H heads of D = width / H channels.

    Attributes:
      state: [N, width] f32, in the decoder, before it has looked at the other cloud.
      queries, keys, values: [N, H, D] f32; the queries are asked of the other cloud.
    """

    state: jax.Array
    queries: jax.Array
    keys: jax.Array
    values: jax.Array


def attention(queries: jax.Array, keys: jax.Array, values: jax.Array, mask: jax.Array) -> jax.Array:
    """``softmax(q k^T / sqrt(D)) v`` for each head (Vaswani et al., 2017, eq. 1): [N, H, D] f32.

    From queries [N, H, D] to keys and values [M, H, D]. Padding, where mask [M] is False, gets no
    weight; with nothing real the answer is a finite mean.
    """
    scores = jnp.einsum("nhd,mhd->hnm", queries * queries.shape[-1] ** -0.5, keys)
    scores = jnp.where(mask[None, None, :], scores, _MASKED)
    top = jax.lax.stop_gradient(jnp.max(scores, -1, keepdims=True))
    weights = jnp.exp(scores - top)
    # divided after the product: the [H, N, M] array is written once
    total = jnp.sum(weights, -1).T[:, :, None]
    return jnp.einsum("hnm,mhd->nhd", weights, values) / total


class LayerNorm(nn.Module):
    """``gain (x - mean) / (std + 1e-6) + bias`` over channels; std with the n - 1 of PyTorch."""

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """From x [N, C] to [N, C]."""
        channels = x.shape[-1]
        gain = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))
        offset = x - jnp.mean(x, -1, keepdims=True)
        std = safe_sqrt(jnp.sum(offset**2, -1, keepdims=True) / (channels - 1))
        return offset * (gain[None, :] / (std + _EPSILON)) + bias[None, :]


class MultiHeadAttention(nn.Module):
    """Attention of points [N, width] to points [M, width]; what both project to can be shared."""

    width: int
    heads: int

    def setup(self) -> None:
        """Names the four projections."""
        self.query, self.key, self.value, self.out = (nn.Dense(self.width) for _ in range(4))

    def queries(self, x: jax.Array) -> jax.Array:
        """[N, H, D] of points x [N, width]."""
        return self.query(x).reshape(len(x), self.heads, -1)

    def keys_and_values(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        """[M, H, D] each, of points x [M, width]."""
        shape = len(x), self.heads, -1
        return self.key(x).reshape(shape), self.value(x).reshape(shape)

    def __call__(
        self, queries: jax.Array, keys: jax.Array, values: jax.Array, mask: jax.Array
    ) -> jax.Array:
        """What the queries [N, H, D] read from keys and values [M, H, D]: [N, width]."""
        return self.out(attention(queries, keys, values, mask).reshape(len(queries), -1))

    def within(self, x: jax.Array, mask: jax.Array) -> jax.Array:
        """Self-attention of points x [N, width] with mask [N]: [N, width]."""
        return self(self.queries(x), *self.keys_and_values(x), mask)


class FeedForward(nn.Module):
    """Two dense layers with a ReLU between them, on every point."""

    hidden: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """From x [N, C] to [N, C]."""
        return nn.Dense(x.shape[-1], name="out")(nn.relu(nn.Dense(self.hidden, name="in")(x)))


class Transformer(nn.Module):
    """Makes the features of one cloud depend on those of another; see `DcpSettings`."""

    width: int = 512
    heads: int = 4
    hidden: int = 1024

    def setup(self) -> None:
        """Names the sublayers of the two blocks, each with its norm."""
        self.encoder_attention = MultiHeadAttention(self.width, self.heads)
        self.encoder_feed_forward = FeedForward(self.hidden)
        self.encoder_norms = [LayerNorm() for _ in range(3)]
        self.decoder_attention = MultiHeadAttention(self.width, self.heads)
        self.cross_attention = MultiHeadAttention(self.width, self.heads)
        self.decoder_feed_forward = FeedForward(self.hidden)
        self.decoder_norms = [LayerNorm() for _ in range(4)]

    def encode(self, x: jax.Array, mask: jax.Array) -> Encoded:
        """The encoder, and the decoder up to where it looks at the other cloud, of x [N, width]."""
        first, second, third = self.encoder_norms
        memory = x + self.encoder_attention.within(first(x), mask)
        memory = third(memory + self.encoder_feed_forward(second(memory)))
        keys, values = self.cross_attention.keys_and_values(memory)
        state = x + self.decoder_attention.within(self.decoder_norms[0](x), mask)
        queries = self.cross_attention.queries(self.decoder_norms[1](state))
        return Encoded(state=state, queries=queries, keys=keys, values=values)

    def decode(self, encoded: Encoded, other: Encoded, other_mask: jax.Array) -> jax.Array:
        """The decoder's output [N, width] for a cloud that looks at another, mask [M] bool."""
        read = self.cross_attention(encoded.queries, other.keys, other.values, other_mask)
        x = encoded.state + read
        return self.decoder_norms[3](x + self.decoder_feed_forward(self.decoder_norms[2](x)))

    def __call__(
        self, x: jax.Array, mask: jax.Array, other: jax.Array, other_mask: jax.Array
    ) -> jax.Array:
        """``decoder(x, encoder(other))``: from [N, width] and [M, width] to [N, width]."""
        return self.decode(self.encode(x, mask), self.encode(other, other_mask), other_mask)
