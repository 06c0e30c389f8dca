"""Parameters from measurements: experiments, fits, and how sure these are."""

from .experiment import Experiment
from .fitting import identify
from .places import Places
from .planning import Plan, plan
from .profile import Profile
from .reading import Curve, MeasuredField, read_curve, read_field
from .result import Compared, Fit, Outlier
from .transforms import Bounds, Linear

__all__ = [
    "Bounds",
    "Compared",
    "Curve",
    "Experiment",
    "Fit",
    "Linear",
    "MeasuredField",
    "Outlier",
    "Places",
    "Plan",
    "Profile",
    "identify",
    "plan",
    "read_curve",
    "read_field",
]
