"""The paper's face-verification experiment: benchmark sets, protocol, figures."""
