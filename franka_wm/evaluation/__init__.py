"""What a trained model is worth: closed loop, open loop, and the intervals around both."""
