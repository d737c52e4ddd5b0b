"""What every experiment shares: config, command line, work folder, sweeps, evaluation."""
