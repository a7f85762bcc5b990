{
  const own = document.currentScript.parentElement;
  const data = JSON.parse(own.querySelector("script[type='application/json']").textContent);
  const show = (k) => {
    own.querySelector("img").src = data.planes[k];
    own.querySelector(".plane").textContent = data.labels[k];
  };
  own.querySelector("input").addEventListener("input", (e) => show(Number(e.target.value)));
}
