from .race_config import RaceConfig as RaceConfig
from .race_env import RaceEnv as RaceEnv
from .race_vector_env import RaceVectorEnv as RaceVectorEnv
from .sb3_vec_env import SB3VecEnv as SB3VecEnv
from .tasks import TaskSet as TaskSet
from .tasks import TaskSplit as TaskSplit
