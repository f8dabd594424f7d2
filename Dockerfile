# docker build -t ce_gym . && docker run --rm ce_gym list
FROM python:3.12-slim
WORKDIR /src
COPY . .
RUN pip install --no-cache-dir ".[viewer,video,train,mjcf]" && rm -rf /src \
    && useradd --create-home user && install -d -o user /work
USER user
WORKDIR /work
ENTRYPOINT ["python", "-m", "ce_gym"]
CMD ["list"]
