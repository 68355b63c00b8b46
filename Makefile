# make demo    scenes -> few-bit frames -> restored video, as one page: out/demo/index.html
# make test    the quick tests (ten minutes on two cores of 2.6 GHz, eighteen on one); make test-slow: the long ones
# make lint    style and types; make docs: the manual into out/site
# make reference    the parts of its pages that come from the code

PYTHON ?= python3
BIN := .venv/bin
EXTRAS := llvm,networks,cluster,denoise,video,formats,publish,s3,tiff,tcspc,draco,docs,dev
# One thread per test process: two processes share two cores.
TEST_ENV := OMP_NUM_THREADS=1 PYTHONWARNINGS=error::SyntaxWarning

.PHONY: setup demo test test-slow lint docs reference clean

setup: .venv/.ready

.venv/.ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info[:2] < (3, 14) else "qsim needs Python 3.11, 3.12 or 3.13, and %s is %s; name another with PYTHON=python3.12" % (sys.executable, sys.version.split()[0]))'
	@$(PYTHON) -m venv .venv || { echo "python -m venv failed: on Debian and Ubuntu install it with 'apt-get install python3-venv'" >&2; exit 1; }
	@echo "Installing qsim and what it needs into .venv (one to five minutes) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@sh .ci/ensure-llvm $(BIN)/python
	@touch $@

demo: setup
	@$(BIN)/qsim demo out/demo

test: setup
	$(TEST_ENV) $(BIN)/python -m pytest -m "not slow" -n 2

test-slow: setup
	$(TEST_ENV) $(BIN)/python -m pytest -m slow -n 2

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

reference: setup
	$(BIN)/python docs/manual/generated.py

docs: setup
	$(BIN)/sphinx-build -W --keep-going -q -E -j auto -d out/doctrees docs out/site

clean:
	rm -rf out .venv build *.egg-info
