"""The controls column of the panel: a control per hyperparameter."""
