"""RPM-Net trained on generic shapes against RPM-Net trained on virtual scans (paper, Figs 8, 9).

python -m experiments.public_vs_virtual --config public.py [--workdir runs/public]
    [--config.data.shapes=PATH] [--trained virtual=runs/vane] [--config.FIELD=VALUE ...]
    [--trained public=partial-trained.pth]

Both have the same network, loss, optimizer and number of steps; only what they see differs. Both
register the same 54 test views of the part. ``data.shapes`` is where ModelNet40 is, a file of
shapes, or "solids" for a procedural family of solids. A checkpoint of the published PyTorch code
may stand in for the network trained on public shapes.

VANEJAX_CACHE_DIR is where compiled programs are kept (~/.cache/vanejax); off keeps none.
"""

from absl import flags

from experiments.runner import command_line
from experiments.studies.public_vs_virtual.study import main

if __name__ == "__main__":
    RUNS = flags.DEFINE_multi_string(
        "trained",
        [],
        "NAME=PATH: public or virtual from a finished run, or from a file of PyTorch weights, "
        "instead of training it",
    )
    command_line.run(lambda config, workdir: main(config, workdir, RUNS.value))
