"""Studies: questions that take many runs; `reproduction.py` has them by name, and `study.py` says what a study is."""
