"""Whether stated standard deviations and verdicts tell which frames and recordings are wrong."""
