"""Direct search on the return: policies are improved by trying nearby ones, without gradients."""
