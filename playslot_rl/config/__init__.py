"""The configuration: frozen dataclasses are the truth, YAML and command-line overrides only change their values.

`from_dict` builds a config from nested plain dicts (what Hydra composes) and refuses unknown keys;
`to_dict` is its inverse; `fingerprint` names a config by its content (all three: `playslot_rl.config.plain`).
"""

from playslot_rl.config.baselines import (
    BaselinesConfig,
    DreamerConfig,
    LAPOConfig,
    OnlineConfig,
    ResNetOracleConfig,
    SOLDConfig,
)
from playslot_rl.config.compare import CompareConfig
from playslot_rl.config.data import CollectConfig, CollectorConfig, DataConfig
from playslot_rl.config.env import BlocksConfig, EnvConfig, GridConfig, RenderConfig
from playslot_rl.config.experiment import EvaluationConfig, ExperimentConfig, ExportConfig, LoggingConfig
from playslot_rl.config.methods import MethodName
from playslot_rl.config.model import (
    ActionDecoderConfig,
    InverseDynamicsConfig,
    LatentMode,
    ModelConfig,
    PolicyConfig,
    PredictorConfig,
    SAViConfig,
)
from playslot_rl.config.plain import fingerprint, from_dict, to_dict
from playslot_rl.config.stages import (
    BehaviourStageConfig,
    DynamicsStageConfig,
    OptimConfig,
    Precision,
    SlotsStageConfig,
    StageConfig,
)

__all__ = [
    "ActionDecoderConfig",
    "BaselinesConfig",
    "BehaviourStageConfig",
    "BlocksConfig",
    "CollectConfig",
    "CollectorConfig",
    "CompareConfig",
    "DataConfig",
    "DreamerConfig",
    "DynamicsStageConfig",
    "EnvConfig",
    "EvaluationConfig",
    "ExperimentConfig",
    "ExportConfig",
    "GridConfig",
    "InverseDynamicsConfig",
    "LAPOConfig",
    "LatentMode",
    "LoggingConfig",
    "MethodName",
    "ModelConfig",
    "OnlineConfig",
    "OptimConfig",
    "PolicyConfig",
    "Precision",
    "PredictorConfig",
    "RenderConfig",
    "ResNetOracleConfig",
    "SAViConfig",
    "SOLDConfig",
    "SlotsStageConfig",
    "StageConfig",
    "fingerprint",
    "from_dict",
    "to_dict",
]
