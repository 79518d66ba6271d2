from .adaptation import AdaptationSettings as AdaptationSettings
from .adaptation import adapt as adapt
from .context_vec_env import ContextVecEnv as ContextVecEnv
from .mql import MQL as MQL
from .propensity import AdaptiveBetaClip as AdaptiveBetaClip
from .propensity import FixedClip as FixedClip
from .propensity import NoClip as NoClip
