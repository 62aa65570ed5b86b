"""Share of time in tolerance against sweeps spent: the curves of `policies.py --json`, a panel a file."""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

#: Beginnings of the names that belong to one curve, and what it is called.
FAMILIES = {
    "q3 and q1 at joint zero every": "q3 and q1 at joint zero, fixed interval",
    "q3 and q1 at the task every": "q3 and q1 at the task, fixed interval",
    "4 chosen every": "4 chosen sweeps, fixed interval",
    "ours": "policy",
    "q3 and q1 when": "when a circle fails",
}
#: Policies that spend more are left to the tables.
MOST_SWEEPS = 800


def panel(axes: plt.Axes, content: dict[str, Any]) -> None:
    """Curves of the first task, and dashed those of all tasks at once where there are several."""
    tasks = content["tasks"]
    policies = {name: p for name, p in content["policies"].items() if p["sweeps"] <= MOST_SWEEPS}
    for number, (beginning, label) in enumerate(FAMILIES.items()):
        found = sorted((p["sweeps"], p) for name, p in policies.items() if name.startswith(beginning))
        shares = [(tasks[0], "-")] if len(tasks) == 1 else [*zip(tasks, (":",) * len(tasks), strict=True), ("all", "-")]
        for share, style in shares if found else []:
            sweeps = np.array([s for s, _ in found])
            whole = share == shares[-1][0]
            axes.errorbar(
                sweeps,
                [p[share] for _, p in found],
                yerr=[p[f"{share}_error"] for _, p in found],
                color=f"C{number}",
                linestyle=style,
                marker="o" if whole else ".",
                alpha=1.0 if whole else 0.6,
                label=label if whole else None,
            )
            if not whole:
                # At the left end, where the curves of the tasks lie apart.
                axes.annotate(
                    share,
                    (sweeps[0], found[0][1][share]),
                    (-4, 0),
                    textcoords="offset points",
                    ha="right",
                    va="center",
                    fontsize=7,
                    color=f"C{number}",
                )
    weeks = max(p["weeks"] for p in policies.values())
    kind = "harder weeks" if content["harder"] else "weeks as modelled"
    axes.set_title(f"up to {weeks} {kind}\n{', '.join(tasks)} within {content['tolerance_nm']:g} nm", fontsize=9)
    axes.axhline(95.0, color="0.5", linewidth=0.8)
    axes.set_xlabel("sweeps in 8 days")
    axes.set_ylabel("share of time in tolerance [%]")
    axes.margins(x=0.12)
    axes.legend(fontsize=7)


def main() -> None:
    """Draw the files that are named."""
    made = argparse.ArgumentParser(description=__doc__)
    made.add_argument("files", nargs="+", type=Path)
    made.add_argument("-o", dest="output", type=Path, required=True, metavar="FIGURE.png")
    options = made.parse_args()
    lines = -(-len(options.files) // 2)
    figure, every = plt.subplots(lines, 2, figsize=(11.0, 4.4 * lines), squeeze=False)
    for axes in every.flat[len(options.files) :]:
        axes.remove()
    for axes, file in zip(every.flat, options.files, strict=False):
        panel(axes, json.loads(file.read_text()))
    figure.tight_layout()
    figure.savefig(options.output, dpi=110)


if __name__ == "__main__":
    main()
