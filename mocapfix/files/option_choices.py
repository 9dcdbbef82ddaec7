"""The names from which options choose."""

DEFAULT_PRIOR_NAME = "autoencoder"
PRIOR_EVERY_FRAME, PRIOR_LOST_LIMBS, NO_TRAINED_PRIOR = "every-frame", "lost-limbs", "none"
PRIOR_SCOPES = (PRIOR_EVERY_FRAME, PRIOR_LOST_LIMBS, NO_TRAINED_PRIOR)
INIT_METHODS = ("hybrik-x", "hybrik-adaptive", "hybrik-naive", "learned", "registration", "previous")
DEFAULT_INIT_METHOD = "hybrik-x"
RIG_NAMES = ("3dsmax", "blender", "cmu", "motionbuilder")  # in scenes/rigs
CHARACTER_PRESETS = ("daz-g8", "daz-g9", "humanik", "metahuman", "mixamo", "rigify", "smpl", "unreal", "vrm")  # in scenes/rigs
EXTRA_FORMAT_NAMES = ("gltf", "amc", "npz", "c3d", "trc", "csv", "contacts", "events", "fbx")
"""formats that are written on request (write.output_formats)"""
REPAIRABLE_KINDS = (
    "gap", "spike", "pop", "flip", "jitter", "stuck", "ghost", "straight", "computed", "swap", "mislabelled", "fragment",
)  # fmt: skip
"""the kinds of fault that a repair can be restricted to; "gap" stands for every kind of missing samples (faults)"""
UNITS = ("mm", "cm", "m", "in", "ft")
UP_AXES = ("X", "-X", "Y", "-Y", "Z", "-Z")
FEET_OFF, FEET_SOFT, FEET_LOCK = "off", "soft", "lock"
FEET_MODES = (FEET_OFF, FEET_SOFT, FEET_LOCK)
PURPOSE_ANIMATION, PURPOSE_LAB = "animation", "lab"
PURPOSES = (PURPOSE_ANIMATION, PURPOSE_LAB)
"""what a cleaned take is for; some options have another default for a laboratory"""
