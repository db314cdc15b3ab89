"""The paper's face-verification experiment: benchmark sets, protocol, baselines, figures."""
