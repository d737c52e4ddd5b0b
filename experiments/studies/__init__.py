"""One folder for each study: what it measures, its table, its picture."""
