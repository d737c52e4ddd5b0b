"""How registration stands what happens at a machine: distance, angle, light, clutter, casting."""

from experiments.runner import study_command
from experiments.studies.robustness.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
