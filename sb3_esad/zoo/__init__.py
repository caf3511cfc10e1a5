"""RL Zoo with our algorithms, searches and evaluations: to import this module is enough, see README, section "RL Zoo"."""

from sb3_esad.zoo.registration import register

register()
