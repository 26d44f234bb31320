"""Direct search on the return: training and polishing without gradients."""
