"""The configuration: frozen dataclasses are the truth, YAML and command-line overrides only change their values.

`from_dict` builds a config from nested plain dicts (what Hydra composes) and refuses unknown keys;
`to_dict` is its inverse; `fingerprint` names a config by its content (all three: `playslot_rl.config.plain`).
"""

from playslot_rl.config.compare import CompareConfig as CompareConfig
from playslot_rl.config.env import BlocksConfig as BlocksConfig
from playslot_rl.config.env import EnvConfig as EnvConfig
from playslot_rl.config.env import GridConfig as GridConfig
from playslot_rl.config.env import RenderConfig as RenderConfig
from playslot_rl.config.experiment import CollectorConfig as CollectorConfig
from playslot_rl.config.experiment import DataConfig as DataConfig
from playslot_rl.config.experiment import EvaluationConfig as EvaluationConfig
from playslot_rl.config.experiment import ExperimentConfig as ExperimentConfig
from playslot_rl.config.experiment import LoggingConfig as LoggingConfig
from playslot_rl.config.model import ActionDecoderConfig as ActionDecoderConfig
from playslot_rl.config.model import InverseDynamicsConfig as InverseDynamicsConfig
from playslot_rl.config.model import LatentMode as LatentMode
from playslot_rl.config.model import ModelConfig as ModelConfig
from playslot_rl.config.model import PolicyConfig as PolicyConfig
from playslot_rl.config.model import PredictorConfig as PredictorConfig
from playslot_rl.config.model import SAViConfig as SAViConfig
from playslot_rl.config.plain import fingerprint as fingerprint
from playslot_rl.config.plain import from_dict as from_dict
from playslot_rl.config.plain import to_dict as to_dict
from playslot_rl.config.planning import PlanConfig as PlanConfig
from playslot_rl.config.stages import BehaviourStageConfig as BehaviourStageConfig
from playslot_rl.config.stages import DynamicsStageConfig as DynamicsStageConfig
from playslot_rl.config.stages import OptimConfig as OptimConfig
from playslot_rl.config.stages import Precision as Precision
from playslot_rl.config.stages import SlotsStageConfig as SlotsStageConfig
from playslot_rl.config.stages import StageConfig as StageConfig
