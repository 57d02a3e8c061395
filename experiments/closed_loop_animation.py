"""A drive in motion, from above, as a GIF: candidates by why they are bad, plan, boundary lines, predictions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from experiments.closed_loop import Drive
from experiments.closed_loop_figures import BAD, GOOD, INK, KERB, OTHER, PLAN, REST, draw_cycle, fan_of
from experiments.tracking_animation import PAPER, scale
from inference.progress import Progress

INCHES = (7.2, 3.56)
PER_SECOND = 10
CANDIDATES = 120  # drawn at most
GROUPS = {  # colours that stay the same over the drive
    "good": GOOD,
    "boundary line": BAD[0],
    "other road user": BAD[1],
    "stop point": BAD[2],
    "a limit": REST,
}


def animation(drive: Drive, *, frames: int = 60) -> dict[str, Any]:
    """frames  at most, spread evenly over the drive; 0 for none"""
    return {"animation": Animation(drive, frames)} if frames else {}


@dataclass(frozen=True)
class Animation:
    """A picture in motion, stored by savefig as a figure is (experiments.report.save_figures), but as GIF."""

    drive: Drive
    frames: int
    suffix: ClassVar[str] = ".gif"

    def savefig(self, file: Path, dpi: float = 130.0) -> None:
        """Draw all frames into a file; a bar tells how far it is where that takes more than two seconds."""
        from matplotlib.animation import PillowWriter
        from matplotlib.figure import Figure

        shown = np.unique(np.linspace(0, len(self.drive.plans) - 1, self.frames).round().astype(int))
        figure = Figure(figsize=INCHES, dpi=min(dpi, 100.0))
        axes = figure.add_axes((0.004, 0.13, 0.992, 0.866))
        writer = PillowWriter(fps=PER_SECOND)
        figure.legend(handles=_handles(), loc="lower center", ncols=4, frameon=False, fontsize=8, columnspacing=1.2)
        with writer.saving(figure, str(file), figure.dpi), Progress("drawing", len(shown)) as bar:
            for number in shown:
                axes.clear()
                self.draw(axes, int(number))
                writer.grab_frame()
                bar.advance(1)

    def draw(self, axes: Any, number: int) -> None:
        """A cycle, with its time, speed and tier."""
        log, fan = self.drive.log, fan_of(self.drive, number, CANDIDATES)
        draw_cycle(axes, self.drive, number, fan, {reason: _colour(reason) for reason in fan.numbers})
        axes.set(xticks=[], yticks=[])
        speed = log.planned[number, 0, 3]
        told = f"{log.cycle[number]:.1f} s   {speed:.1f} m/s   {log.tier[number]}"
        corner: dict[str, Any] = {"transform": axes.transAxes, "bbox": PAPER, "zorder": 9}
        axes.text(0.015, 0.975, told, va="top", fontsize=9, color=INK, **corner)
        scale(axes)


def _colour(reason: int) -> str:
    from planning.check_kernel import REASONS

    return GROUPS.get(REASONS[reason], REST) if reason else GOOD


def _handles() -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    lines = [Line2D([], [], color=PLAN, lw=2.4, label="plan"), Line2D([], [], color=KERB, lw=1.6, label="boundary")]
    lines += [Patch(facecolor=OTHER, label="road users, predictions")]  # type: ignore[list-item]
    return lines + [Line2D([], [], color=colour, lw=1.2, label=name) for name, colour in GROUPS.items()]
