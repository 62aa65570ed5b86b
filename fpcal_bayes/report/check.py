"""A check of a calibration in words and as JSON."""

from typing import Any

import numpy as np

from fpcal_bayes.fringes.path_check import PathCheck, starts_flat


def check_sentences(check: PathCheck, tolerance: float | None) -> list[str]:
    """What a check says, a sentence a line.

    Parameters
    ----------
    tolerance
        Of the peak to peak in um, or None.
    """
    measured, (low, high) = check.measured, check.predicted_band()
    size = f"{1e3 * measured.peak_to_peak:.1f} +- {1e3 * measured.peak_to_peak_sd:.1f} nm"
    lines = [
        f"Measured: the cavity length goes {size} peak to peak beside what the estimate expects along the path.",
        f"Predicted by the estimate: {1e3 * low:.1f} to {1e3 * high:.1f} nm (95 %); with the noise of this recording "
        f"up to {1e3 * float(np.quantile(check.expected, 0.975)):.1f} nm.",
    ]
    chance = f"probability of so much if the calibration holds: {shown_probability(check)}"
    if check.verdict == "confirmed":
        lines.append(f"The calibration is confirmed on the cell ({chance}).")
    elif check.verdict == "refuted":
        lines.append(f"The calibration is refuted on the cell ({chance}): it does not hold any more, or never did.")
    else:
        lines.append(f"Not evaluated: {_reason(check)}.")
    if tolerance is not None and check.verdict != "not evaluated":
        lines.append(_tolerance_sentence(check, tolerance))
    return lines


def shown_probability(check: PathCheck) -> str:
    """The probability, or that it is below what the draws can tell."""
    least = 1.0 / (1.0 + len(check.expected))
    return f"below {2 * least:.1g}" if check.probability < 1.5 * least else f"{check.probability:.2g}"


def check_warnings(check: PathCheck) -> list[str]:
    """Sentences about what weakens a check."""
    measured, warnings = check.measured, []
    if starts_flat(measured):
        height = 50.0 * (1.0 + np.sqrt(1.0 - measured.start_sine**2))
        warnings.append(
            f"the path starts at {height:.0f} % of the way to a fringe's extreme, where 20 nm change the signal by "
            "0.7 % of a fringe's height only; start at half height (quadrature), where they change it by 8 %"
        )
    if measured.rival is not None:
        warnings.append(
            "the signal passes an extreme of the fringe, where it does not tell whether the cavity length went on or "
            f"turned: {1e3 * float(np.ptp(measured.rival)):.1f} nm peak to peak fit as well"
        )
    return warnings


def check_content(check: PathCheck, tolerance: float | None) -> dict[str, Any]:
    """A check as JSON: lengths in nm."""
    measured, (low, high) = check.measured, check.predicted_band()
    content = {
        "verdict": check.verdict,
        "probability": check.probability,
        "level": check.level,
        "peak_to_peak_nm": 1e3 * measured.peak_to_peak,
        "peak_to_peak_sd_nm": 1e3 * measured.peak_to_peak_sd,
        "predicted_nm": {"median": 1e3 * float(np.median(check.predicted)), "low": 1e3 * low, "high": 1e3 * high},
        "expected_high_nm": 1e3 * float(np.quantile(check.expected, 0.975)),
        "share": 0.95,
        "start_sine": measured.start_sine,
        "followed": measured.followed,
        "alternative_nm": None if measured.rival is None else 1e3 * float(np.ptp(measured.rival)),
        "along": measured.at[measured.places].tolist(),
        "error_nm": (1e3 * measured.error[measured.places]).tolist(),
        "error_sd_nm": (1e3 * measured.draws.std(axis=0)).tolist(),
    }
    if tolerance is not None:
        content["tolerance_nm"] = 1e3 * tolerance
        content["within_tolerance_probability"] = within_probability(check, tolerance)
    return content


def within_probability(check: PathCheck, tolerance: float) -> float:
    """Probability, by the measurement alone, that the peak to peak is within a tolerance (um)."""
    measured = check.measured
    sizes = np.ptp(measured.error[measured.places] + measured.draws, axis=1)
    return float((sizes <= tolerance).mean())


def _reason(check: PathCheck) -> str:
    if not check.measured.followed:
        return (
            f"no smooth change of the cavity length makes this signal (it is off by {check.measured.residual:.3g} V, "
            f"the noise is {check.measured.noise:.3g} V)"
        )
    if check.measured.rival is not None:
        return "two changes of the cavity length make this signal, and one of them would confirm the calibration"
    return "the recording is too uncertain to confirm so small an error: its gain or offset drifted, or it is noisy"


def _tolerance_sentence(check: PathCheck, tolerance: float) -> str:
    inside = within_probability(check, tolerance)
    verdict = "within" if inside > 0.975 else "beyond" if inside < 0.025 else "neither clearly within nor beyond"
    return f"The path is {verdict} {1e3 * tolerance:g} nm peak to peak (probability of within: {inside:.3f})."
