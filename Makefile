.PHONY: install lint format test ci dist docs

install:
	pip install -r requirements-dev.txt

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

# Every distribution in one folder: pip install --find-links dist soma-backend-anny
dist:
	for project in . plugins/*/; do python -m build --outdir dist "$$project" || exit 1; done

# docs/_site, with a page that plays a body on its first page; works without a network.
docs:
	soma animate backend=anny backend.params.age=0.2 lod=low 'write=[html]' hydra.run.dir=docs/_live
	python -m sphinx -W --keep-going -b html docs docs/_site
