"""The numbers and the picture of recognition.md: ``python docs/theory/recognition.py [PICTURE.png]``."""

import sys
from collections.abc import Callable, Sequence

import numpy as np

from sonar_graph.measurements import Floats
from sonar_graph.report.figure_style import (
    MUTED,
    arrange,
    blank_panels,
    colour,
)
from sonar_graph.sonar.bayes import jeffrey

Update = Callable[[Floats, Floats], Floats]
"""Belief after a frame, from the belief before it and the frame's scores; shapes (1, 4)."""
UNIFORM = np.full((1, 4), 0.25)
SCORES = np.array([[0.55, 0.25, 0.15, 0.05]])
SURE = np.array([[0.97, 0.01, 0.01, 0.01]])
LIKE_1, LIKE_2 = (
    np.array([[0.80, 0.10, 0.05, 0.05]]),
    np.array([[0.10, 0.80, 0.05, 0.05]]),
)


def right_in(share: float) -> Floats:
    """A confusion matrix of four landmarks that look like themselves in that share of the frames."""
    return np.full((4, 4), (1 - share) / 3) + np.eye(4) * (share - (1 - share) / 3)


def rules(confusion: Floats) -> dict[str, Update]:
    """Both rules, by name; every frame counts in full."""
    return {
        "Jeffrey": lambda belief, scores: jeffrey(belief, scores, confusion),
        "virtual evidence": lambda belief, scores: virtual_evidence(
            belief, scores, confusion, np.ones(1)
        ),
    }


def virtual_evidence(
    predicted: Floats, scores: Floats, confusion: Floats, weights: Floats
) -> Floats:
    """Pearl's rule for scores whose prior is even: each frame multiplies the odds, to the power of its weight."""
    odds = predicted * (scores @ confusion.T) ** weights[:, None]
    return np.asarray(odds / odds.sum(axis=1, keepdims=True))


def beliefs(update: Update, start: Floats, frames: Sequence[Floats]) -> list[float]:
    """Belief in the first landmark after each frame."""
    found = []
    for scores in frames:
        start = update(start, scores)
        found.append(float(start[0, 0]))
    return found


def print_saturation() -> None:
    """Jeffrey's rule ends where the confusion matrix explains the scores."""
    print(
        "The same scores .55 .25 .15 .05 in every frame, from a uniform belief; belief in the first landmark:"
    )
    for name, update in rules(right_in(0.9)).items():
        found = beliefs(update, UNIFORM, [SCORES] * 500)
        first = "  ".join(f"{belief:.3f}" for belief in found[:3])
        print(
            f"  {name:17s} {first}  ...  {found[10]:.4f} after 11 frames  {found[-1]:.4f} after 500"
        )
    solved = np.linalg.solve(right_in(0.9).T, SCORES[0])
    print(f"  the b that solves C'b = s is {np.array2string(solved, precision=3)}")


def print_forgetting() -> None:
    """Scores without information take a belief away."""
    print("Frames that say nothing (.25 .25 .25 .25), from a belief of .97:")
    for name, update in rules(right_in(0.9)).items():
        found = beliefs(update, SURE, [UNIFORM] * 20)
        print(f"  {name:17s} {found[0]:.3f} after 1 frame, {found[-1]:.3f} after 20")


def print_order() -> None:
    """The last frame counts most."""
    print(
        "A frame like landmark 1 (.80 .10 .05 .05) and one like landmark 2 (.10 .80 .05 .05); belief in landmark 1:"
    )
    for name, update in rules(right_in(0.9)).items():
        forth, back = (
            beliefs(update, UNIFORM, frames)[-1]
            for frames in ([LIKE_1, LIKE_2], [LIKE_2, LIKE_1])
        )
        print(f"  {name:17s} {forth:.3f} when 1 comes first, {back:.3f} when 2 does")


def print_news(runs: int = 20_000, frames: int = 10, again: float = 0.9) -> None:
    """Frames that repeat what was seen are not as many witnesses."""
    rng, confusion = np.random.default_rng(0), right_in(0.6)
    looks = [rng.choice(4, runs, p=confusion[0])]
    for _ in range(frames - 1):
        looks.append(
            np.where(
                rng.random(runs) < again, looks[-1], rng.choice(4, runs, p=confusion[0])
            )
        )
    print(
        "Ten frames, each looking as the one before with probability .9, else drawn anew; right in .6 of them:"
    )
    for name, weight in (("all frames count", 1.0), ("weight .1", 1 - again)):
        belief = np.full((runs, 4), 0.25)
        for n, look in enumerate(looks):
            weights = np.full(runs, weight if n else 1.0)
            belief = virtual_evidence(belief, np.eye(4)[look], confusion, weights)
        confidence, right = (
            belief.max(axis=1).mean(),
            (belief.argmax(axis=1) == 0).mean(),
        )
        print(f"  {name:17s} mean confidence {confidence:.2f}, right {right:.2f}")


def draw(path: str) -> None:
    """Belief over frames under both rules: scores that repeat, and scores that stop saying anything."""
    figure, axes = blank_panels(1, 2, (8.4, 3.2), sharey=True)
    figure.set_facecolor("white")
    repeated, fading = [SCORES] * 30, [SCORES] * 10 + [UNIFORM] * 20
    for panel, frames in zip(axes[0], (repeated, fading), strict=True):
        for index, (name, update) in enumerate(rules(right_in(0.9)).items()):
            found = [0.25, *beliefs(update, UNIFORM, frames)]
            panel.plot(
                found,
                "o-",
                color=colour(index),
                markersize=2.5,
                linewidth=1.3,
                label=name,
            )
        panel.axhline(0.9, color=MUTED, linewidth=0.8, linestyle=":")
        panel.set_ylim(0, 1.03)
    axes[0, 1].axvspan(10, 30, color=MUTED, alpha=0.12, linewidth=0)
    axes[0, 1].text(
        20, 0.05, "scores say nothing", color=MUTED, ha="center", fontsize=9
    )
    axes[0, 0].text(
        30,
        0.885,
        "accepted from here on",
        color=MUTED,
        ha="right",
        va="top",
        fontsize=9,
    )
    axes[0, 0].set_xlabel("frame, all with the same scores")
    axes[0, 0].set_ylabel("belief in landmark 1")
    axes[0, 1].set_xlabel("frame")
    axes[0, 0].legend(
        frameon=False, fontsize=9, loc="center right", bbox_to_anchor=(1, 0.32)
    )
    arrange(figure)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    for part in (print_saturation, print_forgetting, print_order, print_news):
        part()
    for picture in sys.argv[1:]:
        draw(picture)
