"""One configuration tree: documented dataclasses, presets as files, one reader of key=value."""

from torchrl_sspl.configs.reader import EnvFactory, compose, load, save
from torchrl_sspl.configs.schema import (
    AugmentationConfig,
    BufferConfig,
    CollectorConfig,
    Config,
    EvaluationConfig,
    LabelsConfig,
    LoggerConfig,
    LossConfig,
    NetworkConfig,
    OptimConfig,
    SynthesisConfig,
    TrainerConfig,
)

__all__ = [
    "AugmentationConfig", "BufferConfig", "CollectorConfig", "Config", "EnvFactory", "EvaluationConfig", "LabelsConfig", "LoggerConfig", "LossConfig",
    "NetworkConfig", "OptimConfig", "SynthesisConfig", "TrainerConfig", "compose", "load", "save",
]  # fmt: skip
