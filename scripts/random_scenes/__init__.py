"""The campaign over random scenes: counts how often a certificate holds, whatever the camera, the runway and the domain are."""
