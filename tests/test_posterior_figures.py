from dataclasses import replace
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from test_cli import refused

from fpcal_bayes.analysis.parameters import most_correlated, tree_draws
from fpcal_bayes.cli import sample as sample_module
from fpcal_bayes.cli.main import main
from fpcal_bayes.core.errors import InputError
from fpcal_bayes.infer.fit.identify import identify
from fpcal_bayes.infer.posterior.leave_out import leave_one_out
from fpcal_bayes.infer.posterior.netcdf import data_tree
from fpcal_bayes.infer.posterior.sample import sample
from fpcal_bayes.io.sweeps import read_sweeps
from fpcal_bayes.report import posterior as figures

CASE_A = Path(__file__).parent / "data" / "case_a.csv"
NAMES = {"ranks.png", "prior-posterior.png", "residuals.png", "pareto-k.png", "pairs.png"}


@pytest.fixture(scope="module")
def posterior(femto):
    """A small posterior of six parameters."""
    sweeps = read_sweeps(CASE_A, femto)
    return sample(identify(femto, sweeps, free=["z_et", "x_wf", "z_wf", "theta_wf", "beta_wf", "theta_6"]), draws=200)


@pytest.fixture(scope="module")
def drawn(posterior):
    """The posterior as a tree, with its leave-one-out."""
    return data_tree(posterior, seed=0, command=""), leave_one_out(posterior, "gaussian", most_refits=0)


class TestFigures:
    def test_all_are_written(self, drawn, tmp_path):
        written = figures.write_posterior_figures(*drawn, tmp_path / "plots")
        assert {path.name for path in (tmp_path / "plots").iterdir()} == NAMES == {path.name for path in written}
        for path in written:
            image = matplotlib.image.imread(path)
            assert min(image.shape[:2]) > 300
            assert image[..., :3].std() > 0.02

    def test_settings_of_the_user_stay(self):
        plt.switch_backend("svg")
        own = plt.figure()
        before, styles = matplotlib.get_backend(), dict(matplotlib.rcParams)
        with figures.off_screen():
            assert matplotlib.get_backend() == "agg"
            plt.figure()
            assert dict(matplotlib.rcParams) != styles
        assert matplotlib.get_backend() == before
        assert plt.get_fignums() == [own.number]
        assert dict(matplotlib.rcParams) == styles
        plt.close(own)

    def test_units_on_every_panel(self, drawn):
        tree, _ = drawn
        with figures.off_screen():
            labels = [axis.get_xlabel() for axis in figures.prior_posterior_figure(tree).axes]
            corner = [axis.get_xlabel() for axis in figures.pair_figure(tree, ["z_et", "theta_wf"]).axes]
        assert {"z_et [um]", "x_wf [um]", "theta_wf [deg]"} <= set(labels)
        assert {"z_et [um]", "theta_wf [deg]"} <= set(corner)

    def test_posterior_line_is_the_posterior(self, drawn):
        """The median of the draws halves what is under the solid line of a panel, the prior's under the dashed."""
        tree, _ = drawn
        with figures.off_screen():
            figure = figures.prior_posterior_figure(tree)
            axis = next(axis for axis in figure.axes if axis.get_xlabel() == "z_wf [um]")
            for line, group in zip(axis.lines, ("prior", "posterior"), strict=True):
                x, y = np.asarray(line.get_xdata()), np.cumsum(np.asarray(line.get_ydata()))
                draws = tree[group]["z_wf"].values
                assert x[np.searchsorted(y, 0.5 * y[-1])] == pytest.approx(np.median(draws), abs=0.25 * draws.std())

    def test_ensembles_that_disagree_are_seen(self, drawn):
        """Ranks of an ensemble that is moved leave the zero line; those of the sampler stay near it."""
        tree, _ = drawn
        moved = tree.copy(deep=True)
        moved["posterior"]["z_wf"][: moved["posterior"].sizes["chain"] // 4] += 2.0 * moved["posterior"]["z_wf"].std()
        with figures.off_screen():
            heights = []
            for each in (tree, moved):
                axis = next(axis for axis in figures.rank_figure(each).axes if axis.get_title() == "z_wf")
                heights.append(max(np.abs(line.get_ydata()).max() for line in axis.lines if len(line.get_ydata()) > 10))
        assert heights[0] < 0.2
        assert heights[1] > 0.4

    def test_residuals(self, drawn):
        """The dots are the measured values in standard deviations; one that is moved leaves the band."""
        tree, _ = drawn
        moved = tree.copy(deep=True)
        moved["observed_data"]["dl_um"][7] += 10.0 * float(tree["posterior_predictive"]["dl_um"][..., 7].std())
        axis = figures.residual_figure(moved).axes[0]
        dots = {line.get_label(): line.get_xydata() for line in axis.lines}
        place, size = next(xy for xy in dots["measured, outside"] if xy[0] == 7)
        assert place == 7
        assert 7.0 < size < 13.0

    def test_rows_above_the_limit_are_named(self, drawn):
        tree, loo = drawn
        k = np.full_like(loo.pareto_k, 0.1)
        k[3] = 0.9
        with figures.off_screen():
            axis = figures.pareto_k_figure(tree, replace(loo, pareto_k=k)).axes[0]
        assert str(tree["observed_data"]["sweep"].values[3]) in {text.get_text() for text in axis.texts}
        assert len(axis.texts) == 1


class TestMostCorrelated:
    def test_largest_first(self, drawn):
        names = most_correlated(drawn[0], 2)
        assert len(names) == 2
        all_names, draws = tree_draws(drawn[0])
        size = np.abs(np.corrcoef(draws.reshape(len(all_names), -1)) - np.eye(len(all_names)))
        assert size[all_names.index(names[0]), all_names.index(names[1])] == pytest.approx(size.max())

    def test_no_more_than_there_are(self, drawn):
        assert most_correlated(drawn[0], 50) == tree_draws(drawn[0])[0]


class TestCommand:
    def test_refused(self, capsys, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        arguments = ("sample", CASE_A, "-o", "p.nc")
        assert "--plots" in refused(capsys, *arguments, "--pairs", "z_et,x_wf")
        assert "at least two" in refused(capsys, *arguments, "--plots", "d", "--pairs", "z_et")
        assert "'nothing'" in refused(capsys, *arguments, "--plots", "d", "--pairs", "z_et,nothing")
        assert "can be made" in refused(capsys, *arguments, "--plots", "missing/d")

    def test_plots(self, capsys, tmp_path, monkeypatch, posterior):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sample_module, "sample", lambda *_, **__: posterior)
        # What is drawn is tested above; here: that it is, from this command's draws.
        drawn = lambda tree, loo, folder, pairs: [folder / str(pairs)]  # noqa: E731
        monkeypatch.setattr(sample_module, "write_posterior_figures", drawn)
        arguments = ["sample", str(CASE_A), "-o", "p.nc", "--draws", "50", "--plots", "d", "--pairs", "z_et,x_wf"]
        assert main(arguments) == 0
        assert "figure: d/['z_et', 'x_wf']" in capsys.readouterr().out
        assert Path("d").is_dir()


def test_folder_that_is_a_file(drawn, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="can be made"):
        figures.write_posterior_figures(*drawn, tmp_path / "file")
