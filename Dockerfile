# docker build -t cnpgen . && docker run -v "$PWD/out:/out" cnpgen make-dataset airhockey-hit --n 1000 -o /out/hits
FROM python:3.12 AS build
WORKDIR /src
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

# The wheel has the compiled C code, so that this stage needs no compiler.
FROM python:3.12-slim
COPY --from=build /wheels /src/constraints.txt /wheels/
RUN pip install --no-cache-dir -c /wheels/constraints.txt "$(ls /wheels/*.whl)[plot]" && useradd --create-home planner
USER planner
WORKDIR /home/planner
ENTRYPOINT ["cnpgen"]
