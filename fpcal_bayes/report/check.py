"""A check of a calibration in words and as JSON."""

from typing import Any

from fpcal_bayes.analysis.traces import CheckNumbers
from fpcal_bayes.fringes.path_check import PathCheck


def check_sentences(check: PathCheck, tolerance: float | None) -> list[str]:
    """What a check says, one sentence per line; `tolerance` of the peak to peak in um."""
    found, measured = CheckNumbers.of(check, tolerance), check.measured
    low, _, high = found.predicted
    size = f"{1e3 * measured.peak_to_peak:.1f} +- {1e3 * measured.peak_to_peak_sd:.1f} nm"
    if not check.trust.usable:
        measured_line = f"Measured: the cavity length goes {size} peak to peak beside what the estimate expects."
        return [measured_line, f"Not evaluated: {check.trust.against}."]
    lines = [
        f"Measured: the cavity length goes {size} peak to peak beside what the estimate expects along the path.",
        f"Predicted by the estimate: {low:.1f} to {high:.1f} nm (95 %); with the noise of this recording "
        f"up to {found.noisy:.1f} nm.",
    ]
    # The draws cannot tell less than this.
    least = 1.0 / (1.0 + len(check.expected))
    shown = f"below {2 * least:.1g}" if check.probability < 1.5 * least else f"{check.probability:.2g}"
    chance = f"probability of so much if the calibration holds: {shown}"
    if check.verdict == "confirmed":
        lines.append(f"The calibration is confirmed on the cell ({chance}).")
    elif check.verdict == "refuted":
        lines.append(f"The calibration is refuted on the cell ({chance}): it does not hold any more, or never did.")
    else:
        lines.append(f"Not evaluated: {_reason(check)}.")
    if tolerance is not None and found.within is not None and check.verdict != "not evaluated":
        within = found.within
        verdict = "within" if within > 0.975 else "beyond" if within < 0.025 else "neither clearly within nor beyond"
        chance = f"probability of within: {within:.3f}"
        lines.append(f"The path is {verdict} {1e3 * tolerance:g} nm peak to peak ({chance}).")
    return lines


def check_warnings(check: PathCheck) -> list[str]:
    """Sentences about what weakens a check."""
    found, warnings = CheckNumbers.of(check), []
    if found.height is not None:
        warnings.append(
            f"the path starts at {found.height:.0f} % of the way to a fringe's extreme, where 20 nm change the signal "
            "by 0.7 % of a fringe's height only; start at half height (quadrature), where they change it by 8 %"
        )
    if found.rival is not None:
        warnings.append(
            "the signal passes an extreme of the fringe, where it does not tell whether the cavity length went on or "
            f"turned: {found.rival:.1f} nm peak to peak fit as well"
        )
    return warnings


def check_content(check: PathCheck, tolerance: float | None) -> dict[str, Any]:
    """A check as JSON: lengths in nm, `tolerance` in um."""
    measured, found = check.measured, CheckNumbers.of(check, tolerance)
    content: dict[str, Any] = {
        "verdict": check.verdict,
        "probability": check.probability,
        "level": check.level,
        "peak_to_peak_nm": 1e3 * measured.peak_to_peak,
        "peak_to_peak_sd_nm": 1e3 * measured.peak_to_peak_sd,
        "predicted_nm": {"median": found.predicted[1], "low": found.predicted[0], "high": found.predicted[2]},
        "expected_high_nm": found.noisy,
        "share": 0.95,
        "start_sine": measured.start_sine,
        "followed": measured.followed,
        "alternative_nm": found.rival,
        "along": measured.at[measured.places].tolist(),
        "error_nm": (1e3 * measured.error[measured.places]).tolist(),
        "error_sd_nm": (1e3 * measured.draws.std(axis=0)).tolist(),
    }
    if not check.trust.usable:
        content |= {"probability": None, "predicted_nm": None, "expected_high_nm": None}
    if tolerance is not None:
        content["tolerance_nm"] = 1e3 * tolerance
        content["within_tolerance_probability"] = found.within if check.trust.usable else None
    return content


def _reason(check: PathCheck) -> str:
    if not check.measured.followed:
        return (
            f"no smooth change of the cavity length makes this signal (it is off by {check.measured.residual:.3g} V, "
            f"the noise is {check.measured.noise:.3g} V)"
        )
    if check.measured.rival is not None:
        return "two changes of the cavity length make this signal, and one of them would confirm the calibration"
    return "the recording is too uncertain to confirm so small an error: its gain or offset drifted, or it is noisy"
