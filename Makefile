# make demo: set up, then the whole job on sample_data.   make test: set up, then the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= demo
# what the wheels of open3d and pymeshlab need from the system at import; and of mitsuba, which tests compare with
SYSTEM := libusb-1.0-0 libegl1 libgl1 libx11-6 libidn2-0 libgomp1 libopengl0
TEST_SYSTEM := libatomic1

.PHONY: demo test lint sample clean

demo: $(VENV)/.ready-demo
	$(BIN)/rangecheck run sample_data --out $(OUT) --force

test: $(VENV)/.ready-test
	$(BIN)/pytest -n 2 --dist loadgroup --no-loadscope-reorder $(PYTEST_ARGS)

lint: $(VENV)/.ready-test
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy && $(BIN)/lint-imports

sample: $(VENV)/.ready-demo
	$(BIN)/rangecheck sample -o sample_data --force

$(VENV)/.ready-demo: pyproject.toml .ci/system-packages | $(VENV)/bin/pip
	.ci/system-packages $(SYSTEM)
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[engines,formats]'
	touch $@

$(VENV)/.ready-test: pyproject.toml .ci/system-packages | $(VENV)/bin/pip
	.ci/system-packages $(SYSTEM) $(TEST_SYSTEM)
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[engines,formats,distributed,test,compare]'
	touch $@ $(VENV)/.ready-demo

# Debian splits venv from python3: where it is missing, install it if we may
$(VENV)/bin/pip:
	$(PYTHON) -c 'import ensurepip' 2>/dev/null || .ci/system-packages --required python3-venv
	$(PYTHON) -m venv $(VENV)

clean:
	rm -rf $(VENV) $(OUT)
