# docker build -t ce_gym . && docker run --rm ce_gym list
FROM python:3.12-slim
WORKDIR /src
COPY . .
RUN pip install --no-cache-dir ".[viewer,video,train,mjcf]" && rm -rf /src \
    && useradd --create-home user && install -d -o user /app
USER user
WORKDIR /app
ENTRYPOINT ["python", "-m", "ce_gym"]
CMD ["list"]
