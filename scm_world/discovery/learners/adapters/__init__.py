"""Learners of other libraries, made to fit our call. None of them is imported before it is used."""
