"""How alike virtual and real scans are, effect by effect, and a sensor fitted to the real ones."""

from experiments.runner import study_command
from experiments.studies.sensor_fit.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
