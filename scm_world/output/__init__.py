"""What a result is written as: files that are whole, pictures, and pages that need nothing else."""
