"""OpenSim's files: TRC, MOT, STO, models and tasks."""
