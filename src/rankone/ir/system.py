"""What a generated module offers: the contract between code generation and the solvers.

A generated module is plain NumPy. It holds a *quadratic* system in separated form: products of
more than two states are lowered by auxiliary algebraic states ("products", ``w = s_a s_b``), which
follow the differential states in ``STATES``. Terms are grouped by *signature*: the tuple of
parameter-factor rows they share, so that one contraction over the parameters serves a whole group.

Within the group ``g`` the right-hand side is

    prod_j parameter_factors(j, p_j)[SIGNATURES[g][j]]
        * (constant_g(t) + linear_g(t) x + quadratic_g(t)(x, x)),

and the kernels below evaluate the bracket on ``P`` time points for ``r`` columns at once.

=====================================  =======================================================
kernel                                 meaning (n states in all, P points)
=====================================  =======================================================
``constant(phi)``                      y (n, P)
``linear(phi, x)``                     x (n, P, r) -> y (n, P, r)
``linear_adjoint(phi, w)``             w (n, P, s) -> v (n, P, s): <w, linear(x)> = <v, x>
``quadratic(phi, x, z)``               x (n, P, r), z (m, P, r, s) -> y (n, P, s); for every
                                       monomial x_a x_b of row c with b = PAIRED[g][k]:
                                       y[c][P, s] += coefficient phi x[a][P, r] z[k][P, r, s],
                                       summed over r
``quadratic_adjoint(phi, x, w)``       x (n, P, r), w (n, P, s) -> v (m, P, r, s):
                                       v[k][P, r, s] += coefficient phi x[a][P, r] w[c][P, s]
=====================================  =======================================================

``phi`` is the array of time factors at the P points, shape (number of time factors, P).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from rankone.support.arrays import Array

__all__ = ["Kernel", "Recipe", "System"]

Kernel = Callable[..., Array]


class Recipe(Protocol):
    """What a system is loaded from; ``system.RECIPE`` of those that rankone compiled. Pickles."""

    @property
    def namespace(self) -> Mapping[str, Callable[..., Any]]:
        """The functions of the user that the system calls."""

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """``function(system, *arguments)``, in any process."""


class System(Protocol):
    """The names a generated module defines."""

    SEPARATED: bool
    """Whether the right-hand side separates. Where it does not, the module has ``initial`` in place
    of ``INITIAL``, and no terms, signatures and kernels."""
    STATES: tuple[str, ...]
    """Differential states, then the auxiliary products."""
    N_DIFFERENTIAL: int
    """Number of differential states."""
    PRODUCTS: tuple[tuple[int, int], ...]
    """For each auxiliary state the indices (a, b) of the states multiplied."""
    PARAMETERS: tuple[str, ...]
    TIME: tuple[float, float]
    BOX: tuple[tuple[float, float], ...]
    TERMS: tuple[tuple[float, int, tuple[int, ...], tuple[int, ...]], ...]
    """Right-hand sides term by term, of any degree: (coefficient, differential state, rows of the
    time factor and of the factor of each parameter, differential states multiplied)."""
    SIGNATURES: tuple[tuple[int, ...], ...]
    """For each group and parameter the row of ``parameter_factors``; row 0 is one."""
    INITIAL: tuple[tuple[float, int, tuple[int, ...]], ...]
    """Initial values: (coefficient, differential state, row for each parameter)."""
    CONSTANT: tuple[Kernel | None, ...]
    LINEAR: tuple[Kernel | None, ...]
    LINEAR_ADJOINT: tuple[Kernel | None, ...]
    QUADRATIC: tuple[Kernel | None, ...]
    QUADRATIC_ADJOINT: tuple[Kernel | None, ...]
    PAIRED: tuple[tuple[int, ...], ...]
    """For each group the second states of its quadratic monomials (the order of z and v)."""
    CUTS: tuple[tuple[float, ...], ...]
    """For each coordinate where functions of it alone jump or kink; only where there are some."""
    PERIODIC_CUTS: tuple[tuple[tuple[float, float], ...], ...]
    """The same for points that repeat: one of them and the period."""
    LIFTED: int
    """How many of the differential states, the last, are functions of the others; only where there
    are some."""
    PEAKS: int
    """How many of the ``events``, the first, vanish in the middle of smooth peaks; only where there
    are some."""
    KINKS: int
    """How many of them, the next, vanish at kinks."""
    JUMPS: tuple[tuple[float, int], ...]
    """Times at which states are reset, ascending, each with the number of its kind; only where
    there are some."""
    ROUGH_JUMPS: tuple[int, ...]
    """The kinds of jumps whose values are no polynomials of the states."""

    GAPS: tuple[str, ...]
    """What to say of each gap of piecewise functions over the states; only where there are some."""
    JUMP_GAPS: tuple[str, ...]
    """The same for what is reset."""

    @staticmethod
    def gaps(t: Any, u: Sequence[Any] | Array, p: Sequence[Any] | Array) -> Array:
        """One where a piecewise function of the rates has no branch, else zero: (gaps, ...); only
        where there are some."""

    @staticmethod
    def jump_gaps(t: Any, u: Sequence[Any] | Array, p: Sequence[Any] | Array) -> Array:
        """The same for what is reset, at the states u before it."""

    @staticmethod
    def initial(p: Sequence[Any] | Array) -> Array:
        """Initial values at p (d, ...), shape (N_DIFFERENTIAL, ...); where nothing separates."""

    @staticmethod
    def coupled_initial(p: Sequence[Any] | Array) -> Array:
        """What of the initial values couples parameters, at p (d, ...): (N_DIFFERENTIAL, ...); only
        where something does."""

    @staticmethod
    def jumped(kind: int, u: Sequence[Any] | Array, p: Sequence[Any] | Array) -> Array:
        """States right after a jump from those before, u (N_DIFFERENTIAL, ...), at p (d, ...):
        (N_DIFFERENTIAL, ...); only where there are some."""

    @staticmethod
    def meanings(t: Any, u: Sequence[Any] | Array, p: Sequence[Any] | Array) -> Array:
        """What the lifted states stand for at the states u (N_DIFFERENTIAL, ...): (LIFTED, ...);
        only where there are some."""

    @staticmethod
    def moving_cuts(p: Sequence[Any] | Array) -> Array:
        """Times at which functions of time and parameters switch at p (d, ...), shape (cuts, ...);
        only where nothing separates and there are some."""

    @staticmethod
    def surfaces(p: Sequence[Any] | Array) -> Array:
        """Functions that vanish, or are least, where others of several parameters are narrow, kink
        or switch, at p (d, ...), shape (surfaces, ...); only where nothing separates and there are
        some."""

    @staticmethod
    def events(t: Any, u: Sequence[Any] | Array, p: Sequence[Any] | Array) -> Array:
        """Functions that vanish where the right-hand side peaks, kinks or switches over the states,
        shape (events, ...); only where nothing separates and there are some."""

    @staticmethod
    def time_factors(t: Array) -> Array:
        """Time factors at the points t (P,): shape (number of factors, P); row 0 is one."""

    @staticmethod
    def parameter_factors(dimension: int, p: Array) -> Array:
        """Factors of one parameter at the points p (N,): shape (number, N); row 0 is one."""

    @staticmethod
    def rhs(t: Any, u: Sequence[Any] | Array, p: Sequence[Any] | Array) -> Array:
        """Pointwise f(t, u, p): u (N_DIFFERENTIAL, ...), p (d, ...) -> (N_DIFFERENTIAL, ...)."""

    @staticmethod
    def jacobian(t: Any, u: Sequence[Any] | Array, p: Sequence[Any] | Array) -> Array:
        """Pointwise df/du, shape (N_DIFFERENTIAL, N_DIFFERENTIAL, ...)."""

    @staticmethod
    def with_products(u: Sequence[Any] | Array) -> Array:
        """Append the products: (N_DIFFERENTIAL, ...) -> (len(STATES), ...)."""

    @staticmethod
    def quadratic_jacobian(t: Any, x: Sequence[Any] | Array, p: Sequence[Any] | Array) -> Array:
        """Jacobian of the quadratic system at x (len(STATES), ...), shape (n, n, ...).

        Rows of the differential states hold f with products as states; the row of a product
        holds the derivative of ``s_a s_b - w``.
        """
