"""DGCNN: features of points from the shape around them (Wang et al., ACM ToG 2019), as in DCP.

DCP's published code builds the graph once, from coordinates, for all layers; the original DGCNN
builds it anew in each. Each edge carries the neighbour's and the point's own coordinates, not their
difference. Published layers have no bias and batch normalisation; here it is group normalisation
(`vanejax.matching.fused_layers`), for which a bias is no redundancy.
"""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp

from vanejax.matching.fused_layers import (
    DenseNormRelu,
    DenseNormReluMax,
    NormedLayer,
    neighbor_sums,
    product,
    product_moments,
)
from vanejax.pointcloud import squared_distances


def neighbor_graph(xyz: jax.Array, mask: jax.Array, *, num_neighbors: int) -> jax.Array:
    """Each point's nearest real points, itself among them.

    From xyz [N, 3] and mask [N] to indices [N, min(K, N)] i32, the nearest first, the lower index
    first among equals. In a cloud of fewer than K points the point itself fills what is left over.
    """
    away = jnp.where(mask[None, :], squared_distances(xyz, xyz), jnp.inf)
    negative, index = jax.lax.top_k(-away, min(num_neighbors, len(xyz)))
    itself = jnp.arange(len(xyz), dtype=index.dtype)
    return jnp.where(jnp.isfinite(negative), index, itself[:, None])


class EdgeLayer(NormedLayer):
    """`DenseNormRelu` on every edge, and its maximum over the neighbours.

    The maximum is that of the bare product. Of the activations, which XLA may compute anew for the
    backward pass and round otherwise, none might then equal it: a gradient of 0 / 0.
    """

    @nn.compact
    def __call__(self, x: jax.Array, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From x [N, K, C] with mask [N] to edges [N, K, features] and points [N, features]."""
        kernel, bias, norm = self.parts(x.shape[-1])
        scale, shift = norm(*product_moments(x, kernel, mask), bias)
        y = product(x, kernel * scale[None, :])
        top, _ = neighbor_sums(y)
        return nn.relu(y + shift[None, None, :]), nn.relu(top + shift[None, :])


class Dgcnn(nn.Module):
    """Shared MLP over the edges, the maximum over the neighbours after each of its layers.

    The ``edge_widths`` are the channels of these layers; see `DcpSettings` for the rest.
    """

    width: int = 512
    num_neighbors: int = 20
    edge_widths: tuple[int, ...] = (64, 64, 128, 256)

    @nn.compact
    def __call__(self, xyz: jax.Array, mask: jax.Array) -> jax.Array:
        """From xyz [N, 3] f32 and mask [N] bool to features [N, width] f32, not negative."""
        index = neighbor_graph(xyz, mask, num_neighbors=self.num_neighbors)
        center = jnp.broadcast_to(xyz[:, None, :], (*index.shape, 3))
        x = jnp.concatenate([jnp.take(xyz, index, axis=0), center], -1)
        tops = []
        for layer, features in enumerate(self.edge_widths[:-1]):
            x, top = EdgeLayer(features, name=f"edge_{layer}")(x, mask)
            tops.append(top)
        # no layer needs this one's edges: its maximum is taken before the normalisation
        last = DenseNormReluMax(self.edge_widths[-1], name=f"edge_{len(self.edge_widths) - 1}")
        tops.append(last(x, mask))
        return DenseNormRelu(self.width, name="point")(jnp.concatenate(tops, -1), mask)
