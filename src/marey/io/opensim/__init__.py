"""Reading and writing files of OpenSim: TRC, MOT, STO, models and tasks."""
