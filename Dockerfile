# syntax=docker/dockerfile:1
FROM python:3.11-slim-bookworm AS builder

ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PYTHONDONTWRITEBYTECODE=1
RUN python -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH
WORKDIR /build

# The CPU wheel alone comes from PyTorch's index (PyPI's brings gigabytes of CUDA); everything else from PyPI.
COPY constraints.txt ./
RUN pip install --no-deps --constraint constraints.txt --index-url https://download.pytorch.org/whl/cpu torch

COPY pyproject.toml README.md LICENSE ./
COPY viflow_anomaly ./viflow_anomaly
COPY service ./service
RUN pip install --constraint constraints.txt '.[openvino,store,webhook,mqtt,otel]' && pip check && pip uninstall --yes pip


FROM python:3.11-slim-bookworm

COPY --from=builder /opt/venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    OMP_WAIT_POLICY=PASSIVE \
    VIFLOW_HOST=0.0.0.0 \
    VIFLOW_PORT=8000

# A number, so that Kubernetes' runAsNonRoot can check it; nothing in the image needs to be written to.
USER 10001:10001
WORKDIR /
EXPOSE 8000
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=30s --timeout=5s --start-period=20s --retries=3 \
    CMD ["python", "-c", "import os, urllib.request as r; r.urlopen('http://127.0.0.1:' + os.environ['VIFLOW_PORT'] + '/healthz', timeout=4)"]
# It ends with instructions, unless VIFLOW_KEY_FILE names a mounted key file or VIFLOW_INSECURE_NO_KEYS=true is given.
ENTRYPOINT ["viflow-anomaly"]
CMD ["serve", "--host", "0.0.0.0"]
