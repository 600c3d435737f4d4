"""Any model: speed and proofs, on models from other packages."""
