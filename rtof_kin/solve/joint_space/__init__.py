"""Fragment solver on configurations of the skeleton: rigid bones, orientations, hinges, limits."""
