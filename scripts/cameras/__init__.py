"""The campaign over cameras and attitudes: counts how often a certificate holds, whatever the lens, the roll and the yaw are."""
