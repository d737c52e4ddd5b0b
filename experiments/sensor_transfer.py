"""What a network that saw virtual scans is worth on real ones, by how real they were."""

from experiments.runner import study_command
from experiments.studies.sensor_transfer.study import main, make_parser

if __name__ == "__main__":
    study_command.run(main, make_parser())
