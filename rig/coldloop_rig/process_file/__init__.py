"""The process file: anybody's process in one TOML, made into the model file that all programs are given."""
