"""`FreeTangents`: the tangent directions in which a foot is free to move, and projection off them."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxfit._closest import dot
from jaxfit._splines._pieces import Pieces

PARALLEL = 1e-12  # squared sines of smaller angles between the tangents count as none


class FreeTangents(NamedTuple):
    """An orthogonal basis: R_u, and the part of R_v orthogonal to it, each 0 where it is not free.

    At a foot on the border a direction is free unless the residual points out of the domain. Of parallel
    tangents one counts. `share` is the component of R_v along R_u. `per_first` and `per_second` are 1 over
    the squared lengths, or 0.
    """

    first: Float[Array, "d ..."]
    second: Float[Array, "d ..."]
    share: Float[Array, "..."]
    per_first: Float[Array, "..."]
    per_second: Float[Array, "..."]

    @staticmethod
    def at(pieces: Pieces, u: Array, v: Array, e: Array, s: Array, t: Array) -> "FreeTangents":
        """At feet (u, v) with residuals `e` and tangents `s` along u and `t` along v."""
        s = jnp.where(_held(pieces.axis_u, u, e, s)[None], 0.0, s)
        t = jnp.where(_held(pieces.axis_v, v, e, t)[None], 0.0, t)
        E, F, G = dot(s, s), dot(s, t), dot(t, t)
        per_first = jnp.where(E > 0, 1.0 / jnp.where(E > 0, E, 1.0), 0.0)
        share = F * per_first
        across = t - share[None] * s
        square = dot(across, across)
        counts = square > PARALLEL * G
        per_second = jnp.where(counts, 1.0 / jnp.where(counts, square, 1.0), 0.0)
        return FreeTangents(s, across, share, per_first, per_second)

    def entries(self) -> Float[Array, "pairs ..."]:
        """The projection I - Pi on these directions, its entries on and above the diagonal."""
        rows, columns = np.triu_indices(self.first.shape[0])
        pairs = zip(rows, columns, strict=True)
        first, second = self.per_first[None] * self.first, self.per_second[None] * self.second
        return jnp.stack([first[a] * self.first[b] + second[a] * self.second[b] for a, b in pairs])

    def normal(self, w: Float[Array, "d ..."]) -> Float[Array, "d ..."]:
        """The part Pi w of vectors in the normal space."""
        along = (self.per_first * dot(self.first, w))[None] * self.first
        return w - along - (self.per_second * dot(self.second, w))[None] * self.second

    def coordinates(self, w: Float[Array, "d ..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """The coefficients of R_u and R_v in the tangential part of vectors."""
        t = self.per_second * dot(self.second, w)
        return self.per_first * dot(self.first, w) - self.share * t, t


def _held(axis: Any, u: Array, e: Array, tangent: Array) -> Array:
    """Whether a foot lies on an end of the domain and its residual keeps it there."""
    along = dot(e, tangent)
    return ((u <= axis.breaks[0]) & (along < 0)) | ((u >= axis.breaks[-1]) & (along > 0))
