"""What was measured, predicted and how uncertain it is: one contract, one file a kind."""
