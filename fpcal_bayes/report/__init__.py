"""Words, tables and figures; computes nothing."""

from fpcal_bayes.core.lazy import lazy

#: Modules of the room, and the names of each that are used outside it.
_PLACES = {
    "campaign.page": "write_campaign_report",
    "cell_picture": "cell_figure",
    "fringes": "draw_sweep",
    "pages": "save_figure",
    "plan_figures": "draw_frontier draw_plan",
    "table": "plain_table",
    "verification": "verification_lines",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
