from .adaptation import adapt as adapt
from .config import AdaptationConfig as AdaptationConfig
from .config import TD3Config as TD3Config
from .context_vec_env import ContextVecEnv as ContextVecEnv
from .mql import MQL as MQL
from .propensity import AdaptiveBetaClip as AdaptiveBetaClip
from .propensity import FixedClip as FixedClip
from .propensity import NoClip as NoClip
