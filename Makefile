.PHONY: install lint format test ci

install:
	pip install -r requirements.txt

lint:
	ruff check .
	ruff format --check .
	mypy

format:
	ruff check --fix .
	ruff format .

test:
	pytest

ci:
	.ci/run
