"""New places for markers that were moved: where they lie on the body that the other markers show."""

from dataclasses import replace

import numpy as np

from mocapfix.kernels import kinematics
from mocapfix.motion import Motion
from mocapfix.subject import Subject

FEWEST = 10  # frames in which a place must be seen


def with_places(subject: Subject, motion: Motion, markers: np.ndarray, which: np.ndarray) -> tuple[Subject, np.ndarray]:
    """-> the subject with one more marker for each new place, and which of the E were seen long enough to have one.

    A place is the median, in the joint's axes, of where the marker is seen; its spread stays its marker's.

    markers  (T, E, 3) metres, NaN where the marker is not at its new place
    which    (E,) the subject's marker that is there
    """
    position, rotation = kinematics.world(subject.skeleton, motion)
    enough = (~np.isnan(markers[..., 0])).sum(0) >= FEWEST
    which, joints = which[enough], subject.joints[which[enough]]
    apart = markers[:, enough] - position[:, joints]
    places = np.nanmedian(np.einsum("tkba,tkb->tka", rotation[:, joints], apart), axis=0).reshape(-1, 3)
    grown = replace(
        subject,
        labels=(*subject.labels, *(subject.labels[k] for k in which)),
        joints=np.r_[subject.joints, joints],
        places=np.r_[subject.places, places],
        spread=np.r_[subject.spread, subject.spread[which]],
        marker_sd=np.r_[subject.marker_sd, subject.marker_sd[which]],
    )
    return grown, enough
