"""Features that oblique imitators read: a network's hidden units, in few bins, the promising ones first."""
