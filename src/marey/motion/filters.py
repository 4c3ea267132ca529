"""Zero-phase filters over time that treat the sections between gaps separately."""

import numpy as np

from marey.arrays import Floats, true_runs
from marey.errors import SettingProblem

MINIMUM_RATE_RATIO = 2.2
"""Values are filtered only at rates above this multiple of the cut-off where filtering is optional; the filter itself
requires more than 2."""
_PASSES = 2
"""Passes of the filter: one forward, one backward."""
_EDGE_PERIODS = 6
"""Length of the continuation at each end in periods of the cut-off; the filter's response has decayed by then."""


def low_pass(values: Floats, *, rate: float, cutoff_hz: float) -> Floats:
    """Smooth by a second-order Butterworth filter applied forward and backward: fourth order without lag.

    The design frequency is raised so that after both passes the gain at the cut-off is 1 / sqrt(2) ([Winter2009]).
    Each run of known values between gaps is filtered separately, with its ends continued point-symmetrically; gaps are
    kept. Typical cut-offs: 6 Hz for walking, 10 to 15 Hz for running.

    Args:
        values: (F, ...) one sample per frame; NaN where unknown.
        rate: Frames per second [Hz].
        cutoff_hz: Frequency at which the gain is 1 / sqrt(2) [Hz].

    Returns:
        (F, ...) smoothed values.

    Raises:
        SettingProblem: The cut-off is not between 0 and half the rate.
    """
    if not 0 < cutoff_hz < rate / 2:
        raise SettingProblem(
            f"A cut-off of {cutoff_hz:g} Hz is invalid at {rate:g} Hz; it should be above 0 and below {rate / 2:g} Hz."
        )
    # Imported where it is needed: it takes a quarter of the time of the start of a program.
    from scipy.signal import butter, sosfiltfilt

    bent = np.tan(np.pi * cutoff_hz / rate) / (2 ** (1 / _PASSES) - 1) ** 0.25
    raised = rate / np.pi * np.arctan(bent)
    sections = butter(2, raised, fs=rate, output="sos")
    columns = np.array(values, float).reshape(len(values), -1)
    for c in range(columns.shape[1]):
        for start, end in true_runs(np.isfinite(columns[:, c])):
            # The filter's response decays within a few periods of the cut-off; a longer continuation changes nothing.
            reach = min(end - start - 1, int(np.ceil(_EDGE_PERIODS * rate / raised)))
            if end - start > 1:
                columns[start:end, c] = sosfiltfilt(sections, columns[start:end, c], padlen=reach)
    return columns.reshape(np.shape(values))
