"""State space in innovation form, discrete time: the model that subspace and prediction-error methods return.

x(t+1) = A x(t) + B u(t - d) + K e(t),  y(t) = C x(t) + D u(t - d) + e(t), equation (2) of Pouliquen et al. 2011 with a
whole number d of samples of dead time besides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.arrays import ComplexArray, FloatArray
from autotune.errors import IdentificationError, InputError


@dataclass(frozen=True, kw_only=True, eq=False)
class InnovationModel:
    """Linear model with its noise spectrum.

    Attributes
    ----------
    A, B, C, D, K : arrays of shape (n, n), (n, n_u), (n_y, n), (n_y, n_u), (n, n_y)
        State matrices; K is the Kalman gain.
    innovation_covariance : (n_y, n_y) array
        Covariance of e, output units squared.
    sample_time_s : float
        Sample time [s].
    input_delay : int
        Dead time d in whole samples, on top of what A, B, C and D say.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    K: FloatArray
    innovation_covariance: FloatArray
    sample_time_s: float = 1.0
    input_delay: int = 0

    def __post_init__(self) -> None:
        n, n_u, n_y = self.order, self.B.shape[1], self.C.shape[0]
        shapes = {"A": (n, n), "B": (n, n_u), "C": (n_y, n), "D": (n_y, n_u), "K": (n, n_y)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"{name} has shape {getattr(self, name).shape}, not {shape}", where="state space")

    def __str__(self) -> str:
        """Return a few lines for people; the matrices are in the attributes."""
        upper = [p for p in self.poles if p.imag >= 0.0]
        poles = [f"{p.real:.4g}" if p.imag == 0.0 else f"{p.real:.4g} +- {p.imag:.4g}j" for p in upper]
        sd = ", ".join(f"{value:.4g}" for value in np.sqrt(np.diag(self.innovation_covariance)))
        return (
            f"model of order {self.order}, {self.B.shape[1]} input(s), {self.C.shape[0]} output(s), "
            f"a row every {self.sample_time_s:g} s, {self.input_delay} row(s) of dead time\n"
            f"poles in z: {', '.join(poles) or 'none'}\n"
            f"standard deviation of the innovations: {sd}"
        )

    @property
    def order(self) -> int:
        """Number of states, dead time not counted."""
        return int(self.A.shape[0])

    @property
    def poles(self) -> ComplexArray:
        """Eigenvalues of A in the z plane, slowest first; dead time not counted."""
        values = np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)
        return values[np.lexsort((-values.imag, np.abs(values - 1.0)))]

    @property
    def predictor_radius(self) -> float:
        """Spectral radius of A - K C: below one, the one-step predictor forgets its initial state."""
        return spectral_radius(self.A - self.K @ self.C)

    def response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return G(exp(j omega Ts)).

        Parameters
        ----------
        omega_rad_s : (W,) array
            Angular frequencies [rad/s]; sensible up to the Nyquist frequency pi / Ts.

        Returns
        -------
        (W, n_y, n_u) array
            Complex gains, output unit per input unit, dead time included, hold not counted.
        """
        z = np.exp(1j * np.asarray(omega_rad_s, dtype=np.float64) * self.sample_time_s)
        inner = self.C @ self.resolvent(omega_rad_s) @ self.B + self.D
        return np.asarray(inner * (z ** -float(self.input_delay))[:, None, None], dtype=np.complex128)

    def noise_response(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return H(exp(j omega Ts)), shape (W, n_y, n_y): the noise model, one at high frequency."""
        return np.asarray(self.C @ self.resolvent(omega_rad_s) @ self.K + np.eye(len(self.C)), dtype=np.complex128)

    def resolvent(self, omega_rad_s: FloatArray) -> ComplexArray:
        """Return (z I - A)^-1 at z = exp(j omega Ts), shape (W, n, n)."""
        z = np.exp(1j * np.asarray(omega_rad_s, dtype=np.float64) * self.sample_time_s)
        return np.asarray(np.linalg.inv(z[:, None, None] * np.eye(self.order) - self.A), dtype=np.complex128)

    def polynomials(self) -> tuple[FloatArray, FloatArray]:
        """Return numerator and denominator in ascending powers of the delay operator, denominator first term 1.

        Raises
        ------
        InputError
            The model has several inputs or outputs.
        """
        if self.B.shape[1] != 1 or self.C.shape[0] != 1:
            raise InputError("polynomials are written for one input and one output", where="state space")
        den = np.real(np.poly(self.A)) if self.order else np.ones(1)
        num = np.convolve(den, self.markov_parameters(self.order + 1)[:, 0, 0])[: self.order + 1]
        return np.concatenate([np.zeros(self.input_delay), num]), den

    def markov_parameters(self, count: int) -> FloatArray:
        """Return the first ``count`` terms D, CB, CAB, ... of the impulse response, shape (count, n_y, n_u)."""
        terms, x = [self.D], self.B
        for _ in range(count - 1):
            terms.append(self.C @ x)
            x = self.A @ x
        return np.stack(terms[:count])

    def with_delay_as_states(self) -> InnovationModel:
        """Return the same model with d = 0: the dead time is a chain of states."""
        model, n_u = self, self.B.shape[1]
        for _ in range(self.input_delay):
            n = model.order
            A = np.block([[model.A, model.B], [np.zeros((n_u, n + n_u))]])
            B = np.vstack([np.zeros((n, n_u)), np.eye(n_u)])
            C = np.hstack([model.C, model.D])
            K = np.vstack([model.K, np.zeros((n_u, C.shape[0]))])
            model = replace(model, A=A, B=B, C=C, D=np.zeros_like(model.D), K=K, input_delay=0)
        return model

    def in_units(self, scale_u: FloatArray, scale_y: FloatArray, sample_time_s: float) -> InnovationModel:
        """Return a model of scaled signals, u / scale_u and y / scale_y, in the signals' own units.

        Parameters
        ----------
        scale_u, scale_y : (n_u,), (n_y,) arrays
            What the signals were divided by.
        sample_time_s : float
            Sample time [s].
        """
        return replace(
            self,
            B=self.B / scale_u,
            C=self.C * scale_y[:, None],
            D=self.D * scale_y[:, None] / scale_u,
            K=self.K / scale_y,
            innovation_covariance=self.innovation_covariance * np.outer(scale_y, scale_y),
            sample_time_s=sample_time_s,
        )


def spectral_radius(A: FloatArray) -> float:
    """Return the largest magnitude of the eigenvalues of A, 0 for an empty matrix."""
    return float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0))


def from_polynomials(
    num: Sequence[float],
    den: Sequence[float],
    noise_num: Sequence[float] = (1.0,),
    *,
    variance: float = 0.0,
    sample_time_s: float = 1.0,
) -> InnovationModel:
    """Return the observer canonical form of den(q) y = num(q) u + noise_num(q) e.

    Parameters
    ----------
    num, den, noise_num : sequence of float
        Ascending powers of the delay operator; ``den`` and ``noise_num`` begin with 1.
    variance : float
        Variance of e, output unit squared.
    sample_time_s : float
        Sample time [s].
    """
    n = max(len(num), len(den), len(noise_num)) - 1
    b, a, c = (np.pad(np.asarray(p, dtype=np.float64), (0, n + 1 - len(p))) for p in (num, den, noise_num))
    A = np.eye(n, k=1)
    A[:, :1] -= a[1:, None]
    return InnovationModel(
        A=A,
        B=(b[1:] - a[1:] * b[0])[:, None],
        C=np.eye(1, n),
        D=b[:1, None],
        K=(c[1:] - a[1:])[:, None],
        innovation_covariance=np.array([[variance]]),
        sample_time_s=sample_time_s,
    )


def balancing(A: FloatArray, B: FloatArray, C: FloatArray) -> FloatArray:
    """Return the state transformation T that balances x(t+1) = A x + B v, y = C x.

    For a one-step predictor (A - K C, [B - K D, K], C): it is stable even where the plant is not, so the coordinates
    T x exist for unstable and integrating plants. Where a state is hardly reached or hardly seen, it is scaled as if it
    were a little more.

    Parameters
    ----------
    A : (n, n) array
        Of the state equation, stable.
    B : (n, inputs) array
        Its inputs.
    C : (outputs, n) array
        Its outputs.

    Returns
    -------
    (n, n) array
        T.

    Raises
    ------
    IdentificationError
        A is not stable.
    """
    if spectral_radius(A) >= 1.0:
        raise IdentificationError("the predictor is not stable", where="balancing")
    reach, observe = _gramian_factor(A, B), _gramian_factor(A.T, C.T)
    U, s, _ = np.linalg.svd(observe.T @ reach)
    return np.asarray((U / np.sqrt(s)).T @ observe.T, dtype=np.float64)


def _gramian_factor(A: FloatArray, B: FloatArray) -> FloatArray:
    """Return L with L L^T the sum of A^k B B^T A^k^T, by doubling; A has spectral radius below one."""
    gramian, power = B @ B.T, A
    for _ in range(40):
        gramian = gramian + power @ gramian @ power.T
        power = power @ power
        if np.max(np.abs(power)) < 1e-8:
            break
    values, vectors = np.linalg.eigh(gramian)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 1e-12 * values[-1])), dtype=np.float64)
