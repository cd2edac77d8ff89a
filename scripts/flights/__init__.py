"""The campaign over flights: counts how often a certificate over time holds, and how soon a fault is found."""
