# Everything runs from .venv, with the versions that constraints.txt pins. `make setup` alone fills it.
#
# PyPI's torch brings several GB of CUDA libraries. To take a CPU wheel from an index or a folder of your own:
#     make setup PIP_EXTRA='--extra-index-url URL'      or      make setup PIP_EXTRA='--find-links FOLDER'

PYTHON ?= python3
PIP_EXTRA ?=
BIN := .venv/bin
PICTURES := .venv/pictures
INSTALLED := .venv/installed
LOWEST := .venv-lowest/bin
LOWEST_INSTALLED := .venv-lowest/installed
SOURCES := $(shell find build_model runtime -name "*.py")

.PHONY: setup setup-lowest test test-lowest lint types demo evidence clean
.DELETE_ON_ERROR:

setup: $(INSTALLED)

# The runtime and what draws: seconds, and enough for the committed model.
$(PICTURES): pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet $(PIP_EXTRA) --constraint constraints.txt --editable '.[pictures]'
	touch $@

# The rest: what builds models, torch among it, and what tests.
$(INSTALLED): $(PICTURES)
	$(BIN)/python -m pip install $(PIP_EXTRA) --constraint constraints.txt --editable '.[dev]'
	touch $@

# A second environment with the lowest versions that pyproject.toml admits, each with the newest of what it needs itself.
setup-lowest: $(LOWEST_INSTALLED)

$(LOWEST_INSTALLED): pyproject.toml scripts/lowest_versions.py
	$(PYTHON) -m venv .venv-lowest
	$(LOWEST)/python scripts/lowest_versions.py > .venv-lowest/lowest.txt
	$(LOWEST)/python -m pip install --quiet $(PIP_EXTRA) --constraint .venv-lowest/lowest.txt --editable '.[dev]'
	touch $@

# onnx's converter between operator sets, and onnxruntime of that age, do not know all that the parity tests convert to.
test-lowest: $(LOWEST_INSTALLED)
	$(LOWEST)/python -m pytest -k "not other_operator_sets"

test: lint types
	$(BIN)/python -m pytest

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(INSTALLED)
	$(BIN)/pyright

demo: $(PICTURES)
	$(BIN)/python scripts/fly_approach.py --model models/paper.onnx --out out/approach
	@echo "Pictures of the committed model are in out/approach. Now the same model is built here: torch is installed, and a network trained."
	@$(MAKE) --no-print-directory out/paper.onnx
	$(BIN)/python scripts/fly_approach.py --model out/paper.onnx --out out/approach_built

out/paper.onnx: models/paper.toml constraints.txt $(SOURCES) | $(INSTALLED)
	mkdir -p $(@D)
	$(BIN)/export-model $< -o $@

out/approach.onnx out/drone.onnx: out/%.onnx: models/%.toml $(INSTALLED)
	$(BIN)/export-model $< -o $@ --estimator none

evidence: out/paper.onnx out/approach.onnx out/drone.onnx test-lowest
	$(BIN)/verify-model $<
	$(BIN)/verify-model out/approach.onnx
	$(BIN)/verify-model out/drone.onnx
	$(BIN)/python -m pytest -m evidence
	$(BIN)/python -m pytest --hypothesis-profile=long
	$(BIN)/python scripts/fuzz.py $< --minutes 10 -o out/fuzz
	$(BIN)/python scripts/coverage $< --frames 24000 -o out/coverage.json
	$(BIN)/python scripts/coverage out/approach.onnx --frames 2400 -o out/coverage_approach.json
	$(BIN)/python scripts/coverage out/drone.onnx --frames 2400 -o out/coverage_drone.json
	$(BIN)/python scripts/random_scenes -o out/random_scenes.json
	$(BIN)/python scripts/cameras --cameras 200 --frames 10000 -o out/cameras.json
	$(BIN)/python scripts/flights $< -o out/flights.json

clean:
	rm -rf .venv .venv-lowest out dist build .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
