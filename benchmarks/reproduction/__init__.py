"""The study of the CausalWorld paper."""
