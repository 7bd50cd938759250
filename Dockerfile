# docker build -t cnpgen . && docker run -v "$PWD/out:/out" cnpgen make-dataset airhockey-hit --n 1000 -o /out/hits
FROM python:3.12-slim
WORKDIR /src
COPY . .
RUN pip install --no-cache-dir -c constraints.txt '.[plot,compiler]' && useradd --create-home planner
USER planner
WORKDIR /home/planner
ENTRYPOINT ["cnpgen"]
