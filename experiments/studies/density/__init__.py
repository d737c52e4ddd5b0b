"""RMSE and FFMDE over the density of the points at a fixed pose error: the paper's Fig. 1."""
