"""How well the verdict tells right poses from wrong ones, over parts and sensors."""

from experiments.runner import study_command
from experiments.studies.verdicts.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
