"""A finished policy improved by the critics of the actor that it was made from."""
