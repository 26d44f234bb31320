"""What the learners that grow one tree from the root share: greedy growth and the search for splits."""
