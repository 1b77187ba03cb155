"""How far a reduced solution is from satisfying the equations of the fields themselves.

The residual of u = V a, divided into what does not depend on time, coefficients and parameters, and
numbers that do, costs as many operations as there are products of two columns, whatever the size of
the fields (Haasdonk & Ohlberger, Math. Comput. Model. Dyn. Syst. 17 (2011), 145).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rankone.solvers.reduced.field_bases import Interpolation
from rankone.solvers.reduced.field_modes import FieldModes
from rankone.solvers.reduced.reduced_system import ReducedSystem, spread_modes
from rankone.support.arrays import Array
from rankone.trajectories.fields.field_system import FieldSystem


class FieldResidual:
    """The residual, in the root mean square over entries in units of the sizes of the fields.

    Functions count as far as they are interpolated.
    """

    def __init__(
        self,
        fields: FieldSystem,
        modes: FieldModes,
        interpolations: Sequence[Interpolation],
        reduced: ReducedSystem,
    ) -> None:
        self._reduced = reduced
        spread = spread_modes(modes)
        columns = [spread if fields.mass is None else fields.mass @ spread]
        columns += [-(term.matrix @ spread) for term in fields.linear]
        columns += [-term.vector[:, None] for term in fields.sources]
        columns += [
            -(term.after @ interpolation.modes) @ interpolation.weights
            for term, interpolation in zip(fields.pointwise, interpolations, strict=True)
        ]
        together = np.concatenate(columns, axis=1)
        pairs = zip(modes.unknowns, modes.scales, strict=True)
        scale = [np.full(u.size, size * np.sqrt(u.size)) for u, size in pairs]
        together /= np.concatenate(scale)[:, None]
        _, self._triangle = np.linalg.qr(together)

    def __call__(self, t: Array, a: Array, p: Array) -> Array:
        """The residual (m,) at times (m,), coefficients (R, m) and parameters (d, m)."""
        reduced = self._reduced
        c, numbers = reduced.coefficients.coefficients(t, p), [reduced.rates(t, a, p)]
        numbers += [c[k] * a for k in reduced.linear_numbers]
        numbers += [c[k][None] for k in reduced.source_numbers]
        numbers += [c[g.coefficient] * reduced.values(g, t, a, p) for g in reduced.pointwise]
        rows = self._triangle @ np.concatenate(numbers)
        return np.asarray(np.sqrt(np.square(rows).sum(axis=0)))
