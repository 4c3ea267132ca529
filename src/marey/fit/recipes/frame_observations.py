"""Further observations of single frames of any kind in the refinement of a whole motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.pose import Pose, PosedBody
from marey.body.articulation.surface import Body
from marey.fit.recipes.sequence_equations import FrameTerms
from marey.fit.solver.pose_solver import add_dense
from marey.observations.observation import Observation


@dataclass(frozen=True, eq=False)
class FrameObservations:
    """Observations by frame, as `marey.fit.recipes.sequence_equations.FrameTermsFactory` provides them."""

    by_frame: Mapping[int, Sequence[Observation]]
    """Observations of each frame; frames without any may be missing."""
    shared: int = 0
    """Number of unknowns that all frames share beside the shape: none."""

    def terms_of_round(self, poses: Mapping[int, Pose], body: Body) -> FrameTerms:
        """Return the terms of a round; they do not depend on the other frames."""
        return self

    def terms(self, frame: int, posed: PosedBody) -> tuple[Floats, Floats]:
        """Return the normal equations of a frame's observations by pose and shape.

        Args:
            frame: The frame.
            posed: The body in its present pose.

        Returns:
            Information (D + M, D + M) and gradient (D + M,).
        """
        size = len(posed.body.skeleton) + len(posed.body.space)
        information, gradient = np.zeros((size, size)), np.zeros(size)
        add_dense(posed, self.by_frame.get(frame, ()), information, gradient, shape=True)
        return information, gradient
