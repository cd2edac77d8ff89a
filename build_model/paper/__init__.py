"""The paper's own formulas, corrected: references and oracles beside what the build uses."""
