"""Training of lifters: motion, simulated detections and sensors, losses and the loop; not imported by inference."""
