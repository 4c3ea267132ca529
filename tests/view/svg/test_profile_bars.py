import re

from marey.motion.events.profile import ProfileScore
from marey.view.pictures.palette import side_colour
from marey.view.svg.profile_bars import profile_bars


def score(side: str, value: float, *, name: str = "knee flexion", worst: float = 6.0) -> ProfileScore:
    return ProfileScore(name=name, side=side, score_deg=value, reference_deg=3.0, reference_worst_deg=worst)


def widths(drawing: str, kind: str) -> list[float]:
    return [float(width) for width in re.findall(rf'<rect {kind} x="[\d.]+" width="([\d.]+)"', drawing)]


def test_the_length_of_a_bar_is_proportional_to_its_score():
    drawing = profile_bars([("walk", None, [score("left", 2.0), score("right", 4.0)])])
    (left,) = widths(drawing, f'fill="{side_colour("left_")}"')
    (right,) = widths(drawing, f'fill="{side_colour("right_")}"')
    usual = widths(drawing, 'class="usual"')
    assert abs(right - 2 * left) < 0.15
    assert abs(usual[0] - 1.5 * left) < 0.15
    assert len(usual) == 2


def test_each_walk_has_a_bar_of_its_colour_and_names_are_escaped():
    walks = [("before <b>", "#112233", [score("left", 2.0)]), ("after", "#445566", [score("left", 4.0)])]
    drawing = profile_bars(walks)
    assert len(widths(drawing, 'fill="#112233"')) == len(widths(drawing, 'fill="#445566"')) == 1
    assert "before &lt;b&gt;: 2.0°" in drawing
    assert "<b>" not in drawing


def test_the_score_of_all_angles_is_the_last_row():
    scores = [score("both", 1.0, name="gait profile score"), score("left", 2.0)]
    drawing = profile_bars([("walk", None, scores)])
    assert drawing.index("knee flexion, left") < drawing.index(">gait profile score<")


def test_equal_walks_are_drawn():
    assert "<svg" in profile_bars([("walk", None, [ProfileScore(
        name="knee flexion", side="left", score_deg=0.0, reference_deg=0.0, reference_worst_deg=0.0
    )])])  # fmt: skip
