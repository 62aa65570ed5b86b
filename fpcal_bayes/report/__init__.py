"""Words, tables and figures; computes nothing."""

from fpcal_bayes.core.lazy import lazy

#: Names that are used outside the package, and the module of the room in which each stands.
_PLACES = {
    "cell_figure": "cell_picture",
    "draw_frontier": "plan_figures",
    "draw_plan": "plan_figures",
    "plain_table": "table",
    "save_figure": "pages",
    "verification_lines": "verification",
    "write_campaign_report": "campaign.page",
}

__all__, __getattr__, __dir__ = lazy(__name__, _PLACES)
