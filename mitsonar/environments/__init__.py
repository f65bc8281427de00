"""Environments of Gymnasium whose observations are sonar images; importing this registers ``mitsonar/Sonar-v0``."""

from gymnasium.envs.registration import register

register(
    id="mitsonar/Sonar-v0",
    entry_point="mitsonar.environments.sonar_env:SonarEnv",
    vector_entry_point="mitsonar.environments.sonar_vector_env:SonarVectorEnv",
)
