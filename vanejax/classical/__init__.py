"""Classical registration: closest points, robust estimation, sampled features."""
