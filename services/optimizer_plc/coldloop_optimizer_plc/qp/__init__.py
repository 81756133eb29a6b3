"""The quadratic problem: prediction, condensing, constraints, costs, the parametrised profile."""
