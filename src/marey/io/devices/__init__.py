"""Files of foreign devices: force plates, EMG, IMU and other signals with clocks of their own."""
