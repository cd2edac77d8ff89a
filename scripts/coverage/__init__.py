"""The coverage campaign: counts how often a certificate holds."""
