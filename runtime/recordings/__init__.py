"""The extra `recordings`: files of events to estimates, pictures and timings. Nothing of the embedded runtime imports it."""
