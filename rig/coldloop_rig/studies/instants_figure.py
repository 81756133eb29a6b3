"""The figure of sets of instants: what each loses in the loop, and what a PLC does of its iterations."""

from collections.abc import Sequence

from matplotlib.figure import Figure

from coldloop_rig.figures.plot import COLOURS, DASHES, INK
from coldloop_rig.studies.drawing import legend_outside, panels
from coldloop_rig.studies.instants import ENOUGH, Judged, losses, proposed


def drawn(found: Sequence[Judged], names: Sequence[str]) -> Figure:
    """Return loss and iterations over the number of variables; the configured and the proposed set are named.

    Args:
        found: The sets, the configured one first, the fullest last.
        names: The loads.
    """
    sets = sorted(found[1:], key=lambda one: one.variables)
    sizes = [one.variables for one in sets]
    with panels(2, 1, 4.6, sharex=True) as (figure, (loss, iterations)):
        for name, colour, cost, fullest in zip(
            names, COLOURS, zip(*(one.costs for one in sets), strict=True), found[-1].costs, strict=False
        ):
            loss.plot(
                sizes,
                [each / fullest for each in cost],
                color=colour,
                linestyle=DASHES[colour],
                marker=".",
                label=f"load {name}",
            )
        loss.axhline(ENOUGH, color=INK, linewidth=0.8, linestyle=":", label=f"small enough, {ENOUGH:g}")
        iterations.plot(sizes, [one.iterations for one in sets], color=COLOURS[0], marker=".")
        lost = dict(zip([one.label for one in found], losses(found), strict=True))
        for label, one, marker in (("configured", found[0], "s"), ("proposed", proposed(found), "o")):
            for axes, value in ((loss, lost[one.label]), (iterations, one.iterations)):
                axes.plot(one.variables, value, color=INK, marker=marker, markerfacecolor="none", markersize=9,
                          linestyle="", label=label)  # fmt: skip
        loss.set_ylabel("loss: J_BF over the fullest (1)")
        iterations.set_ylabel(f"iterations in {found[0].design.process.sampling_period_s:g} s (1)")
        iterations.set_xlabel("variables (1)")
        iterations.set_xscale("log")  # the fullest set has several times the variables of the others
        marks = [mark for mark in (10, 20, 50, 100, 200, 500) if sizes[0] <= mark <= sizes[-1]]
        iterations.set_xticks(marks, map(str, marks))
        iterations.minorticks_off()
        legend_outside(figure, loss)
    return figure
