"""Direct closed-loop subspace methods: the feedback is met by a long autoregression, not by a controller model.

Both estimate the state as a linear function of past data that predicts the future outputs, then A, B, C, D and K by
two regressions. They are consistent with feedback as long as one sample of delay lies in the loop and the past window
is long enough for (A - K C)^p to be forgotten; a window too short biases them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_discrete_are, solve_triangular

from autotune.arrays import FloatArray
from autotune.errors import IdentificationError
from autotune.identification.closed_loop.lagged import lagged_factor, least_squares, triangle
from autotune.identification.closed_loop.series import Series
from autotune.identification.closed_loop.state_space import InnovationModel

#: Standard deviation of the white noise supposed on past samples, as a share of the signal's root mean square.
_TRACE_OF_NOISE = 1e-6
#: Below this share of the largest a singular value is rounding.
_RANK = 1e-11


@dataclass(frozen=True, kw_only=True, eq=False)
class LaggedData:
    """Triangular factor of [z(t-1) ... z(t-p), u(t), y(t)] with z = (u, y), which is all a direct method needs.

    Attributes
    ----------
    R : (columns, columns) array
        Upper triangular.
    rows : int
        Rows of data behind it.
    p, n_u, n_y : int
        Past window and numbers of inputs and outputs.
    """

    R: FloatArray
    rows: int
    p: int
    n_u: int
    n_y: int

    def past(self, count: int | None = None) -> slice:
        """Return the columns of the first ``count`` lags (all when absent)."""
        return slice(0, (self.p if count is None else count) * (self.n_u + self.n_y))

    @property
    def now(self) -> tuple[slice, slice]:
        """Return the columns of u(t) and of y(t)."""
        at = self.past().stop
        return slice(at, at + self.n_u), slice(at + self.n_u, at + self.n_u + self.n_y)

    def window(self, count: int) -> LaggedData:
        """Return the data with a shorter past of ``count`` lags, from the same rows."""
        keep = np.r_[0 : self.past(count).stop, self.now[0].start : self.R.shape[1]]
        return replace(self, R=triangle(self.R[:, keep]), p=count)


def lagged_data(u: FloatArray, y: FloatArray, p: int, starts: tuple[int, ...] = (0,)) -> LaggedData:
    """Return the factor of the past p samples and the present one; one pass, time linear in the rows.

    A trace of white noise (1e-6 of each signal) is supposed on the past: noise-free records, whose lags depend on each
    other exactly, then have a predictor too.

    Parameters
    ----------
    u, y : (N, n_u), (N, n_y) arrays
        The record.
    p : int
        Past window, in samples.
    starts : tuple of int
        First row of each stretch.
    """
    series, past = Series(u=u, y=y, starts=starts), range(-1, -p - 1, -1)
    R, rows = lagged_factor(*([(np.hstack(one), past), (one[0], [0]), (one[1], [0])] for one in series.stretches))
    R = _with_trace_of_noise(R, p * (u.shape[1] + y.shape[1]))
    return LaggedData(R=R, rows=rows, p=p, n_u=u.shape[1], n_y=y.shape[1])


def _with_trace_of_noise(R: FloatArray, width: int) -> FloatArray:
    trace = np.zeros((width, R.shape[1]))
    np.fill_diagonal(trace, _TRACE_OF_NOISE * np.linalg.norm(R[:, :width], axis=0))
    return triangle(np.vstack([R, trace]))


def autoregression(data: LaggedData) -> FloatArray:
    """Return the long ARX model y(t) = sum Phi_k z(t-k) + e.

    Parameters
    ----------
    data : LaggedData
        Factor of p past samples and the present one.

    Returns
    -------
    (p, n_y, n_u + n_y) array
        Markov parameters Phi_k = C (A - K C)^(k-1) [B, K] of the predictor.
    """
    width = data.past().stop
    theta = solve_triangular(data.R[:width, :width], data.R[:width, data.now[1]], check_finite=False)
    return np.asarray(theta.T.reshape(data.n_y, data.p, data.n_u + data.n_y).transpose(1, 0, 2))


def choose_past_window(data: LaggedData) -> int:
    """Return the number of lags of the long autoregression that Akaike's criterion prefers.

    One triangular factor holds the residuals of every shorter window: the recent lags come first.
    """
    _, now_y = data.now
    rows_y = data.R[:, now_y]
    left = np.cumsum((rows_y[:, :, None] * rows_y[:, None, :])[::-1], axis=0)[::-1] / data.rows
    k = np.arange(1, data.p + 1)
    signs, log_dets = np.linalg.slogdet(left[k * (data.n_u + data.n_y)])
    criterion = data.rows * log_dets + 2.0 * k * (data.n_u + data.n_y) * data.n_y
    return int(k[np.argmin(np.where(signs > 0, criterion, np.inf))])


def pbsid_states(data: LaggedData, f: int) -> FloatArray:
    """Return the states of PBSIDopt (Chiuso 2007) before their number is chosen: the SVD of the outputs Gamma K Z_p.

    Parameters
    ----------
    data : LaggedData
        Past window p.
    f : int
        Future window, at most p.

    Returns
    -------
    (f n_y, p (n_u + n_y)) array
        Row i gives the i-th candidate state from the lags z(t-1) ... z(t-p), the strongest first.
    """
    phi = autoregression(data)
    n_z = data.n_u + data.n_y
    gamma_k = np.zeros((f * data.n_y, data.p * n_z))
    for i in range(f):
        for k in range(data.p - i):
            gamma_k[i * data.n_y : (i + 1) * data.n_y, k * n_z : (k + 1) * n_z] = phi[k + i]
    past = data.past()
    U, s, _ = np.linalg.svd(gamma_k @ data.R[past, past].T, full_matrices=False)
    scale = np.sqrt(np.maximum(s, _RANK * max(s[0], np.finfo(np.float64).tiny)))
    return np.asarray((U / scale).T @ gamma_k, dtype=np.float64)


def regress_system(data: LaggedData, states: FloatArray, order: int) -> InnovationModel:
    """Return A, B, C and K from two regressions on the states: the outputs, then the next states.

    Parameters
    ----------
    data : LaggedData
        Factor of the past and the present.
    states : (candidates, p (n_u + n_y)) array
        Weights of the past that give the states, the most telling first.
    order : int
        How many of them are taken.

    Raises
    ------
    IdentificationError
        Fewer candidate states than ``order``.
    """
    if order > len(states):
        raise IdentificationError(f"order {order} needs a longer future window than {len(states)}")
    T = states[:order]
    now_u, now_y = data.now
    n_z, R = data.n_u + data.n_y, data.R
    past = data.past()
    shifted = np.r_[now_u.start : now_y.stop, 0 : past.stop - n_z]  # z(t), z(t-1), ... z(t-p+1)
    X, X_next, U, Y = R[:, past] @ T.T, R[:, shifted] @ T.T, R[:, now_u], R[:, now_y]
    C = least_squares(X, Y).T
    E = Y - X @ C.T
    ABK = least_squares(np.hstack([X, U, E]), X_next).T
    model = InnovationModel(
        A=ABK[:, :order],
        B=ABK[:, order : order + data.n_u],
        C=C,
        D=np.zeros((data.n_y, data.n_u)),
        K=ABK[:, order + data.n_u :],
        innovation_covariance=E.T @ E / data.rows,
    )
    return with_stable_predictor(model)


def with_stable_predictor(model: InnovationModel) -> InnovationModel:
    """Return the model with a Kalman gain whose predictor is stable: the same spectrum, its factor made stable.

    Where no such gain is found (a pole on the unit circle that the noise does not reach) a little noise on every
    state is supposed.
    """
    if model.predictor_radius < 0.9995:
        return model
    sigma = model.innovation_covariance + 1e-12 * np.eye(len(model.C)) * np.trace(model.innovation_covariance)
    K, n = model.K, model.order
    size = np.trace(K @ sigma @ K.T) / max(n, 1) + np.finfo(np.float64).tiny
    for extra in (1e-6, 1e-3, 1.0, 1e3):
        Q = K @ sigma @ K.T + extra * size * np.eye(n)
        try:
            P = solve_discrete_are(model.A.T, model.C.T, Q, sigma, s=K @ sigma)
        except (np.linalg.LinAlgError, ValueError):
            continue
        gain = (model.A @ P @ model.C.T + K @ sigma) @ np.linalg.inv(model.C @ P @ model.C.T + sigma)
        stable = replace(model, K=np.asarray(gain, dtype=np.float64))
        if stable.predictor_radius < 0.9995:
            return stable
    raise IdentificationError("the start has no stable predictor", remedy="ask for another --order")


def pbsid_opt(u: FloatArray, y: FloatArray, order: int, *, p: int, f: int) -> InnovationModel:
    """Identify by PBSIDopt (Chiuso 2007).

    Parameters
    ----------
    u, y : (N, n_u), (N, n_y) arrays
        Input and output, mean removed.
    order : int
        Number of states.
    p, f : int
        Past and future window, f <= p.

    Notes
    -----
    Consistent with feedback for p growing with the record; a bias of the order of (A - K C)^p remains. Not efficient:
    polish it with :func:`autotune.identification.closed_loop.prediction_error.prediction_error`.
    """
    data = lagged_data(u, y, p)
    return regress_system(data, pbsid_states(data, f), order)


def ssarx(u: FloatArray, y: FloatArray, order: int, *, p: int, f: int) -> InnovationModel:
    """Identify by SSARX (Jansson 2003, 2005): future outputs freed of future inputs by a long ARX model, then CCA.

    Parameters
    ----------
    u, y : (N, n_u), (N, n_y) arrays
        Input and output, mean removed.
    order : int
        Number of states.
    p, f : int
        Past and future window.

    Notes
    -----
    Asymptotically equivalent to PBSIDopt (Chiuso 2006); no feedthrough.
    """
    data = lagged_data(u, y, p)
    phi = autoregression(data)
    n_u, n_y, n_z = data.n_u, data.n_y, data.n_u + data.n_y
    z = np.hstack([u, y])
    R, _ = lagged_factor([(z, range(-1, -p - 1, -1)), (z, range(f))])
    R, width = _with_trace_of_noise(R, R.shape[1]), p * n_z  # without noise the future has exact dependencies as well
    past, future = R[:, :width], R[:, width:].reshape(len(R), f, n_z)
    freed = future[:, :, n_u:].copy()
    for i in range(f):
        for k in range(i):  # z(t + k) acts on y(t + i) through Phi_(i-k)
            freed[:, i] -= future[:, k] @ phi[i - k - 1].T if i - k <= p else 0.0
    freed = freed.reshape(len(R), f * n_y)
    Y_half, Z_half = np.linalg.qr(freed)[1], R[:width, :width]
    cross = np.linalg.solve(Y_half.T, freed.T @ past) @ np.linalg.pinv(Z_half, rcond=_RANK)
    Vt = np.linalg.svd(cross, full_matrices=False)[2]
    weights = least_squares(Z_half, Vt.T).T * np.sqrt(data.rows)
    return regress_system(data, weights, order)
