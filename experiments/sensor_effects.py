"""Every effect of the sensor alone: a picture to check by eye, and what it costs."""

from experiments.runner import study_command
from experiments.studies.sensor_effects.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
