"""Detection of wrong frames and recordings by stated standard deviations and verdicts."""
