"""What the learners share: scikit-learn's contract, declared parameters, trees from leaves."""
