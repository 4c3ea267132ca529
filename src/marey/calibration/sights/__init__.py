"""What single views show without a common solution: poses of the board, other clocks, exchanged and turned cameras."""
